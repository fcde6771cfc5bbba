// A scene in one file: PlayCanvas blends its Gaussians as linear light into half floats; light.js exposes them.
"use strict";

const $ = id => document.getElementById(id);
const facts = JSON.parse($("facts").textContent), light = new LightCanvas($("picture")), camera = new FlyingCamera(facts.up);
const stage = $("stage"), STILL_AFTER = 160, DRAFT_TIME = 60;
let app, eye, material, color, target, sorted = 0, timer = 0, scale = 0.5;

async function start() {
  if (!light.gl) throw new Error("this browser has no WebGL2, by which the scene is drawn");
  light.putCurve(facts.curve);
  const unpacked = async name => {
    const values = await unpackLight($(name).textContent);
    $(name).remove();  // Of a large scene 60 MB of text, which phones lack
    return values;
  };
  const means = new Float32Array((await unpacked("means")).buffer), half = await unpacked("rest");
  const count = means.length / 3;
  const properties = facts.columns.map((name, k) => {
    const storage = k < 3 ? means.subarray(k * count, (k + 1) * count) : Float32Array.from(half.subarray((k - 3) * count, (k - 2) * count), fromHalf);
    return {name, type: "float", storage, byteSize: 4};
  });
  const device = await pc.createGraphicsDevice($("engine"), {deviceTypes: ["webgl2"], antialias: false});
  const options = new pc.AppOptions();
  options.graphicsDevice = device;
  options.componentSystems = [pc.CameraComponentSystem, pc.GSplatComponentSystem];
  options.resourceHandlers = [pc.TextureHandler, pc.ContainerHandler, pc.GSplatHandler];
  app = new pc.AppBase($("engine"));
  app.init(options);
  app.setCanvasResolution(pc.RESOLUTION_FIXED, 16, 16);
  app.autoRender = false;
  const splat = new pc.Entity();
  // Not unified: that renderer keeps colors in formats that end at 1.
  splat.addComponent("gsplat", {unified: false});
  splat.gsplat.resource = new pc.GSplatResource(device, new pc.GSplatData([{name: "vertex", count, properties}]));
  app.root.addChild(splat);
  material = splat.gsplat.instance.material;
  asOurs(material, pc.ShaderChunks.get(device, pc.SHADERLANGUAGE_GLSL));
  eye = new pc.Entity();
  // As far as the engine knows its colors are encoded, and it leaves them as they are.
  eye.addComponent("camera", {clearColor: new pc.Color(0, 0, 0, 1), toneMapping: pc.TONEMAP_NONE, gammaCorrection: pc.GAMMA_SRGB});
  app.root.addChild(eye);
  app.start();
  splat.gsplat.instance.sorter.on("updated", () => { sorted++; request(timer !== 0); });
  facts.views.forEach((view, i) => $("view").add(new Option("photo " + view.name, i)));
  new ResizeObserver(moved).observe(stage);
  jump(opening());
}
const opening = () => facts.opening || facts.views[facts.first].camera;

// The engine's Gaussians end early, are lifted to make up for it, are left out where small, shrunk where larger than the
// picture, and drawn at any nearness; ours end at the same opacity alone and behind the near plane. Both linearize the
// projection, ours no farther outside of the picture, and of the photos, than a margin. The engine's low-pass filter has a fourth of our
// variance, because its lengths are half pixels. Here it is the photos' filter (see pixel_filter.py) and at least a
// pixel's, and opacities keep the light that the photos' filter gives.
function asOurs(material, chunks) {
  const change = (name, from, to) => {
    const own = material.getShaderChunks(pc.SHADERLANGUAGE_GLSL), before = own.get(name) || chunks.get(name), after = before.replace(from, to);
    if (after === before) throw new Error(`the engine has another ${name}`);
    own.set(name, after);
  };
  change("gsplatCommonVS", /min\(1.0, (sqrt\(max\(0.0, log\(alpha \/ alphaClipValue\)\)\) \* 0.5)\)/, "$1");
  change("gsplatPS", /if \(A > 1.0\) \{\s*discard;\s*\}\s*mediump float alpha = normExp\(A\)/, "mediump float alpha = exp(A * -4.0)");
  change("gsplatCornerVS", "float vmin = min(1024.0, min(viewport_size.x, viewport_size.y));", "float vmin = 1e9;\n\tif (center.proj.w < camera_params.z) return false;");
  change("gsplatCornerVS", "vec2 J2 = -J1 / vp.z * vp.xy;",
    `vec2 at = clamp(center.proj.xy / center.proj.w, ${-1 - facts.margin}, ${1 + facts.margin}) + matrix_projection[2].xy;\n\t\tvec2 most = vec2(${facts.rays.map(x => x.toFixed(6))}) * vec2(center.projMat00, center.projMat11);\n\t\tat = clamp(at, -most, most);\n\t\tvec2 J2 = J1 * at / vec2(center.projMat00, center.projMat11);`);
  change("gsplatCornerVS", "uniform float minPixelSize;", "uniform float minPixelSize;\nuniform float photoFilter, pixelFilter;");
  change("gsplatCornerVS", /cov(\[.\])\1 \+ 0\.3/g, "cov$1$1 + pixelFilter");
  change("gsplatCornerVS", "detOrig = cov[0][0] * cov[1][1]", "detOrig = (cov[0][0] + photoFilter) * (cov[1][1] + photoFilter)");
  change("gsplatCornerVS", "vec2(offDiagonal, lambda1 - diagonal1)", "vec2(offDiagonal + 1e-12, lambda1 - diagonal1)");  // Not (0, 0)
  material.setParameter("minPixelSize", 0);
  material.setDefine("GSPLAT_AA", true);
  material.update();
}

function resize(width, height) {
  if (target && target.width === width && target.height === height) return;
  if (target) target.destroy(), color.destroy();
  const filters = {minFilter: pc.FILTER_NEAREST, magFilter: pc.FILTER_NEAREST};
  color = new pc.Texture(app.graphicsDevice, {width, height, format: pc.PIXELFORMAT_RGBA16F, mipmaps: false, ...filters});
  target = new pc.RenderTarget({colorBuffer: color, depth: true});
  eye.camera.renderTarget = target;
}

function place(c) {  // The engine's camera: OpenGL axes, +y up and +z back
  const [x, y, z] = c.world_to_camera, at = centerOf(c), pose = new pc.Mat4(), near = facts.near, far = Math.max(facts.size, near) * 1e3;
  pose.set([x[0], x[1], x[2], 0, -y[0], -y[1], -y[2], 0, -z[0], -z[1], -z[2], 0, ...at, 1]);
  eye.setPosition(pose.getTranslation());
  eye.setRotation(new pc.Quat().setFromMat4(pose));
  eye.camera.nearClip = near, eye.camera.farClip = far;
  eye.camera.calculateProjection = matrix => matrix.set([2 * c.fx / c.width, 0, 0, 0, 0, 2 * c.fy / c.height, 0, 0,
    1 - 2 * c.cx / c.width, 2 * c.cy / c.height - 1, -(far + near) / (far - near), -1, 0, 0, -2 * far * near / (far - near), 0]);
  const variance = facts.photo_eps2d * (c.fx / Math.min(Math.max(c.fx, facts.focals[0]), facts.focals[1])) ** 2;
  material.setParameter("photoFilter", 4 * variance);
  material.setParameter("pixelFilter", 4 * Math.max(variance, facts.eps2d));
}

function moved() {
  delete stage.dataset.frame;
  clearTimeout(timer);
  timer = setTimeout(() => { timer = 0, request(false); }, STILL_AFTER);
  request(true);
}
const request = requester(async draft => {
  if (!stage.clientWidth || !draft && !sorted) return;  // A full picture waits for the first order of its Gaussians, which asks for it.
  const started = performance.now();
  await render(draft ? scale : 1);
  if (draft) scale = Math.min(1, Math.max(0.15, scale * Math.min(1.5, Math.max(0.5, Math.sqrt(DRAFT_TIME / (performance.now() - started))))));
  else if (request.wanted === null && sorted) stage.dataset.frame = "full", $("status").textContent = document.title;
});
async function render(part) {
  const ratio = Math.min(window.devicePixelRatio || 1, 2) * part, [width, height] = [stage.clientWidth, stage.clientHeight].map(x => Math.max(8, Math.round(x * ratio)));
  resize(width, height);
  place(stage.pose = camera.at(width, height));
  app.renderNextFrame = true;
  await new Promise(done => app.once("frameend", done));
  const rows = await color.read(0, 0, width, height, {renderTarget: target, immediate: true}), upright = new Uint16Array(rows.length);
  for (let y = 0; y < height; y++) upright.set(rows.subarray(4 * width * (height - 1 - y), 4 * width * (height - y)), 4 * width * y);
  $("picture").width = width, $("picture").height = height;
  light.put("scene", width, height, upright, 4);
  paint();
}
function paint() {
  const stops = Number($("stops").value);
  $("stopsLabel").textContent = `${stopsText(stops)} \u00b7 ${secondsText(facts.base_time * 2 ** stops)}`;
  if (light.frames.scene) light.draw({stops, tone: $("tone").value, grey: facts.grey});
}
function jump(view) {
  camera.jump(view, facts);
  moved();
}

$("stops").addEventListener("input", paint);
$("tone").addEventListener("change", paint);
$("view").addEventListener("change", () => jump($("view").value ? facts.views[$("view").value].camera : opening()));
$("panel").addEventListener("submit", event => event.preventDefault());
const pointers = new Map();  // That are down, with their places
stage.addEventListener("pointerdown", event => { stage.setPointerCapture(event.pointerId); pointers.set(event.pointerId, [event.clientX, event.clientY]); });
for (const end of ["pointerup", "pointercancel"]) stage.addEventListener(end, event => pointers.delete(event.pointerId));
stage.addEventListener("pointermove", event => {
  const last = pointers.get(event.pointerId);
  if (!last) return;
  const size = Math.min(stage.clientWidth, stage.clientHeight), x = (event.clientX - last[0]) / size, y = (event.clientY - last[1]) / size;
  const before = [...pointers.values()];
  pointers.set(event.pointerId, [event.clientX, event.clientY]);
  if (before.length === 2) camera.pinch(before, [...pointers.values()], size);
  else camera.drag(event, x, y);
  moved();
});
stage.addEventListener("contextmenu", event => event.preventDefault());
stage.addEventListener("wheel", event => { camera.wheel(event); moved(); }, {passive: false});
document.addEventListener("keydown", event => {
  if (event.target.matches("input, select") || event.ctrlKey || event.metaKey) return;
  const pace = facts.size * 0.03, step = {w: [0, 0, pace], s: [0, 0, -pace], a: [-pace, 0, 0], d: [pace, 0, 0], e: [0, pace, 0], q: [0, -pace, 0]}[event.key.toLowerCase()];
  if (step) camera.fly(...step), moved();
  if (event.key === "[" || event.key === "]") { $("stops").value = (Math.round(3 * Number($("stops").value)) + (event.key === "]" ? 1 : -1)) / 3; paint(); }
  if (event.key === "Home") { $("view").value = ""; jump(opening()); }
});
start().catch(error => { $("status").textContent = error.message; });
