// The viewer's page: asks for float frames as the camera moves; exposure and looks are the page's own.
"use strict";

const $ = id => document.getElementById(id);
const stage = $("stage"), picture = $("picture"), drawing = $("drawing");
const DRAFT_TIME = 90, STILL_AFTER = [140, 600];  // Milliseconds that a picture may take while moving; then comes the full one
let runs, light, camera, facts, state = {stops: 0, photo: 0, split: 0.5, pointer: null, keys: new Set(), path: []};
let draftScale = 0.5, fullTime = 0, stillTimer = 0, drawn = null, playing = 0;

async function ask(path, body) {
  const options = body && {method: "POST", headers: {"Content-Type": "application/json"}, body: JSON.stringify(body)};
  const answer = await fetch(path, options).catch(() => { throw new Error(over()); });
  if (!answer.ok) throw new Error(await answer.text());
  return answer;
}

const over = () => $("training").hidden ? "the server is gone" : "the training has ended; `sehdr-warp view` shows the run";

async function start() {
  const answer = await (await ask("scene")).json();
  runs = answer.runs, facts = runs[0], light = new LightCanvas(picture);
  for (const option of light.gl ? [] : document.querySelectorAll("[data-shaded]")) {
    option.disabled = true;
    option.textContent += " (needs WebGL2)";
  }
  document.title = facts.scene + " \u00b7 sehdr-warp";
  document.body.inert = false;
  camera = new FlyingCamera(facts.up);
  facts.views.forEach((view, i) => $("view").add(new Option(`${view.name} (${view.split})`, i)));
  runs.forEach((run, i) => {
    $("run").add(new Option(label(run), i));
    if (runs.length > 1) $("left").add(new Option(label(run), "run" + i));
    $("merge").add(new Option(label(run), i));
  });
  $("runRow").hidden = $("mergeRow").hidden = runs.length < 2;
  $("edit").hidden = $("lights").hidden = $("share").hidden = answer.training;
  if (answer.training) startTraining();
  else setInterval(renew, 2000);
  useRun(0);
  new ResizeObserver(resize).observe(stage);
  home();
  if (facts.history.length > 1) note(description());
}
// The path of a run without the folders that all runs share.
function label(run) {
  const paths = runs.map(each => each.name.split("/")), [first] = paths;
  const differs = first.findIndex((part, i) => paths.some(path => i === path.length - 1 || path[i] !== part));
  return run.name.split("/").slice(differs).join("/");
}
const home = () => jump(facts.opening && facts.views.length ? nearestView(facts.opening) : facts.first, facts.opening);
// The photo that was taken nearest to a camera, in about its direction.
function nearestView(pose) {
  const center = centerOf(pose), forward = pose.world_to_camera[2].slice(0, 3);
  const distances = facts.views.map(view => Math.hypot(...add(centerOf(view.camera), center, -1)) / facts.size
    + 1 - dot(view.camera.world_to_camera[2].slice(0, 3), forward));
  return distances.indexOf(Math.min(...distances));
}

// Shows what a training of another process has written meanwhile.
async function renew() {
  if (document.hidden) return;
  try {
    const versions = await (await ask("versions")).json();
    if (versions.every((version, i) => version === runs[i].version)) return;
    const answer = await (await ask("scene")).json(), views = all => JSON.stringify(all.map(run => run.views));
    if (views(answer.runs) !== views(runs)) return location.reload();  // Another scene
    const edits = JSON.stringify(facts.history);
    runs = answer.runs;
    useRun(state.run);
    if (JSON.stringify(facts.history) !== edits) note(description());  // By another page
    request(false);
  } catch (error) { tell(error.message); }
}

function useRun(index) {
  facts = runs[index];
  light.putCurve(facts.curve);
  light.settings.grey = facts.grey;
  $("overlay").querySelector("[value=clipped]").disabled = !facts.clipped;
  if (state.run !== index || state.merged !== facts.merged) listLights(null);
  Object.assign(state, {run: index, merged: facts.merged});
  offer();
  $("findLights").disabled = !facts.clipped;
  const noPhotos = !facts.views.length;  // As of a file
  for (const id of ["view", "asPhoto", "frusta"]) $(id).disabled = noPhotos;
  for (const [id, value] of [["left", "photo"], ["overlay", "error"]]) $(id).querySelector(`[value=${value}]`).disabled = noPhotos || !light.gl;
  measured();
  expose();
}

function resize() {
  const ratio = window.devicePixelRatio || 1, width = Math.round(stage.clientWidth * ratio), height = Math.round(stage.clientHeight * ratio);
  if (!width || !height) return;
  drawing.width = width, drawing.height = height;
  paint();
  moved();
}

// Takes the place of a photo, or another one near it.
function jump(index, place) {
  const view = facts.views[index];
  if (!view && !place) { camera.jump({width: 4, height: 3, fx: 3, fy: 3, cx: 2, cy: 1.5, world_to_camera: [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}, {size: 2}); return moved(); }
  $("zoom").value = 0;
  if (view) $("view").value = index;
  camera.jump(place || view.camera, facts);
  if (view) loadPhoto(index);
  moved();
}

async function loadPhoto(index) {
  state.photo = index, state.photoReady = null;
  if (!usesPhoto()) return;
  tell("the photo is being read \u2026");
  try {
    const blob = await (await ask(`photo/${state.run}/${index}`)).blob();
    const image = await createImageBitmap(blob, {colorSpaceConversion: "none"});
    if (state.photo !== index) return;
    light.putPhoto(image);
    state.photoReady = index;
    tell(state.status);
    paint();
  } catch (error) { tell(error.message); }
}
const usesPhoto = () => $("left").value === "photo" || $("overlay").value === "error";
function nearestPhoto() {
  if (!usesPhoto() || !facts.views.length) return;
  const nearest = nearestView(drawn.camera);
  if (nearest !== state.photo || state.photoReady !== nearest) loadPhoto(nearest);
}

// Asks for a draft now and for the full picture when nothing has moved for a while.
function moved() {
  delete stage.dataset.frame;
  clearTimeout(stillTimer);
  // What takes seconds should not begin at a hand's short rest.
  stillTimer = setTimeout(() => request(false), Math.min(STILL_AFTER[1], Math.max(STILL_AFTER[0], fullTime / 4)));
  request(true);
}
const request = requester(async draft => {
  try { if (drawing.width) await load(draft); } catch (error) { tell(error.message); await new Promise(done => setTimeout(done, 500)); }
});
async function load(draft) {
  const scale = draft ? draftScale : 1, width = Math.max(16, Math.round(drawing.width * scale)), height = Math.max(16, Math.round(drawing.height * scale));
  const pose = camera.at(width, height, zoom()), started = performance.now(), clipped = $("overlay").value === "clipped";
  const left = $("left").value, other = left.startsWith("run") ? Number(left.slice(3)) : null;
  const fetched = async (run, clip) => new Uint16Array(await (await ask("frame", {run, camera: pose, draft, clipped: clip})).arrayBuffer());
  const [half, second] = await Promise.all([fetched(state.run, clipped), other === null ? null : fetched(other, false)]);
  const n = width * height, took = performance.now() - started;
  picture.width = width, picture.height = height;  // Shaded at the frame's size: the browser enlarges drafts.
  light.put("scene", width, height, half.subarray(0, 4 * n), 4);
  light.put("depth", width, height, half.subarray(4 * n, 5 * n), 1);
  if (half.length > 5 * n) light.put("clipped", width, height, half.subarray(5 * n), 1);
  if (second) light.put("other", width, height, second.subarray(0, 4 * n), 4);
  if (draft && $("training").hidden) draftScale = Math.min(1, Math.max(0.08, draftScale * Math.min(1.5, Math.max(0.5, Math.sqrt(DRAFT_TIME / took)))));
  if (!draft) fullTime = took;
  drawn = {camera: pose, draft};
  const depths = Uint16Array.from({length: Math.floor(n / 13)}, (_, i) => half[4 * n + 13 * i]).filter(d => d > 0).sort();  // As integers
  const [near, far] = [0.02, 0.98].map(part => fromHalf(depths[Math.floor(part * depths.length)] || 0x3c00));
  Object.assign(light.settings, {near, far});
  legend();
  tell(state.status = `${width} \u00d7 ${height} \u00b7 ${took.toFixed(0)} ms \u00b7 ${counts(facts.gaussians)} Gaussians`
    + (facts.iterations && $("training").hidden ? ` \u00b7 ${facts.iterations} steps` : ""));
  if (!draft) nearestPhoto();
  histogram();
  frusta();
  paint();
  if (!draft && request.wanted === null) stage.dataset.frame = "full";  // Nothing better is to come
}
const counts = number => number.toLocaleString("en").replaceAll(",", "\u202f");
const tell = text => { $("status").textContent = text; };
const zoom = () => 2 ** Number($("zoom").value);

function paint() {
  if (!drawn || !facts) return;
  // A photo that is still being read is not compared with.
  const ready = state.photoReady === state.photo, left = $("left").value === "photo" && !ready ? "0" : $("left").value, split = left === "0" ? 0 : state.split, view = facts.views[state.photo];
  const photo = view ? {toPhoto: between(drawn.camera, view.camera), photoLens: lensOf(view.camera), ...projectionOf(view.camera)} : {};
  light.draw({stops: state.stops, tone: $("tone").value, white: 2 ** Number($("white").value), overlay: $("overlay").value === "error" && !ready ? "none" : $("overlay").value,
              split, left: left === "photo" ? 2 : left === "0" ? 0 : 1, lens: lensOf(drawn.camera), ...photo});
  $("whiteLabel").textContent = stopsText(Number($("white").value));
  $("handle").hidden = left === "0";
  $("handle").style.left = 100 * state.split + "%";
  [left === "photo" ? view.name : left.startsWith("run") ? label(runs[Number(left.slice(3))]) : "", runs.length > 1 ? label(facts) : "scene"]
    .forEach((name, i) => { $("handle").children[i].textContent = name; });
  probe();
}

function expose() {
  $("stops").value = state.stops;
  $("stopsLabel").textContent = stopsText(state.stops);
  if (document.activeElement !== $("seconds")) $("seconds").value = secondsText(facts.base_time * 2 ** state.stops);
  bars();
  paint();
}
function secondsOf(text) {
  const [a, b] = text.replace("s", "").split("/").map(Number);
  return b === undefined ? a : a / b;
}

function frusta() {
  const context = drawing.getContext("2d"), scale = drawing.width / drawn.camera.width;
  context.clearRect(0, 0, drawing.width, drawing.height);
  state.apexes = [];
  marks();
  if (!$("frusta").checked) return;
  context.lineWidth = 1.2 * (window.devicePixelRatio || 1);
  facts.views.forEach((view, i) => {
    const c = view.camera, m = c.world_to_camera, center = centerOf(c), size = facts.size * 0.06;
    const wide = c.projection ? Math.max(1, c.width / 2 / c.fx) : 1;  // The frustum of a wide lens shows 90 degrees.
    const corner = (x, y) => {
      const ray = [(x - c.cx) / c.fx / wide, (y - c.cy) / c.fy / wide, 1].map(v => v * size);
      return project(drawn.camera, [0, 1, 2].map(k => center[k] + m[0][k] * ray[0] + m[1][k] * ray[1] + m[2][k] * ray[2]));
    };
    const apex = project(drawn.camera, center), corners = [corner(0, 0), corner(c.width, 0), corner(c.width, c.height), corner(0, c.height)];
    if (!apex || corners.includes(null)) return;
    context.strokeStyle = view.split === "train" ? "#e0a458" : "#7fb2c4";
    context.beginPath();
    corners.forEach((at, k) => {
      const next = corners[(k + 1) % 4];
      context.moveTo(apex[0] * scale, apex[1] * scale);
      context.lineTo(at[0] * scale, at[1] * scale);
      context.lineTo(next[0] * scale, next[1] * scale);
    });
    context.stroke();
    state.apexes.push([i, apex[0] * scale, apex[1] * scale]);
  });
}

const figure = x => x === 0 ? "0" : Math.abs(x) < 1e-3 || x >= 1e5 ? x.toExponential(1) : Math.abs(x) >= 1e3 ? counts(Number(x.toPrecision(3))) : x.toPrecision(3);
function probe() {
  const at = state.pointer, side = at && $("left").value.startsWith("run") && at[0] < state.split ? "other" : "scene";
  const value = at && light.value(side, ...at), rows = [];
  if (value) {
    const [r, g, b, sure] = value, time = facts.base_time, l = luminance(value) * facts.grey * 2 ** state.stops;
    rows.push(["radiance", [r, g, b].map(x => (x < HALVES[0x7bff] ? "" : "\u2265") + figure(x / time)).join("&ensp;")]);
    rows.push(["from grey", l > 0 ? stopsText(Math.log2(l / 0.18)) : "\u2013"]);
    rows.push(["confidence", drawn.draft || side === "other" || sure < 0 ? "\u2013" : `${Math.round(100 * sure)} %`]);
    rows.push(["depth", figure(light.value("depth", ...at)[0])]);
    state.probed = [r, g, b].map(x => x / time);
  } else for (const name of ["radiance", "from grey", "confidence", "depth"]) rows.push([name, "\u2013"]);
  $("probe").innerHTML = rows.map(([name, text]) => `<dt>${name}</dt><dd>${text}</dd>`).join("");
}

const BINS = 96, LOWEST = -16, HIGHEST = 16;  // Stops from middle grey at 0 EV
function histogram() {
  const {half, width, height} = light.frames.scene, step = Math.max(1, Math.floor(width * height / 40000)), bins = new Float32Array(BINS);
  for (let k = 0; k < half.length; k += 4 * step) {
    const l = luminance([HALVES[half[k]], HALVES[half[k + 1]], HALVES[half[k + 2]]]) * facts.grey / 0.18;
    const bin = Math.floor((Math.log2(l) - LOWEST) / (HIGHEST - LOWEST) * BINS);
    if (bin >= 0 && bin < BINS) bins[bin]++;
  }
  state.bins = bins;
  bars();
}
function bars() {
  const canvas = $("histogram"), context = canvas.getContext("2d"), bins = state.bins, most = bins ? Math.max(...bins, 1) : 1;
  context.clearRect(0, 0, 248, 74);
  const place = stops => (stops + 10) / 20 * 248;  // The axis is what is shown: the bars move with the exposure.
  context.fillStyle = "#3a3835";
  context.fillRect(place(0), 0, 1, 60);
  context.fillRect(place(Math.log2(1 / 0.18)), 0, 1, 60);
  for (let i = 0; bins && i < BINS; i++) {
    const stops = LOWEST + i * (HIGHEST - LOWEST) / BINS + state.stops, high = 58 * Math.sqrt(bins[i] / most);
    context.fillStyle = stops >= Math.log2(1 / 0.18) ? "#e0a458" : "#a6a29c";
    context.fillRect(place(stops), 60 - high, 248 / 20 * (HIGHEST - LOWEST) / BINS - 0.5, high);
  }
  context.fillStyle = "#8a8783";
  context.font = "10px system-ui";
  context.textAlign = "center";
  for (const stops of [-8, -4, 0, 4, 8]) context.fillText(stops === 0 ? "grey" : stops > 0 ? "+" + stops : "\u2212" + -stops, place(stops), 72);
}

function legend() {
  const kind = $("overlay").value;
  const ramp = kind === "clipped" ? ["#666", "#8c5d55", "#b35344", "#d94a33", "#ff4026"] : ["#1a1738", "#1b3f5f", "#216b8c", "#8da973", "#fae059"];
  const ends = {confidence: ["unknown", "known"], clipped: ["never", "always"], depth: [`far ${figure(light.settings.far)}`, `near ${figure(light.settings.near)}`], error: ["0", "\u00bc"]}[kind];
  if (kind === "stops") {
    $("legend").innerHTML = Array.from({length: 17}, (_, i) => `<i style="background:rgb(${bandColor(i - 8)})"><span>${i % 4 ? "" : i - 8}</span></i>`).join("");
  } else $("legend").innerHTML = ends ? ramp.map((c, i) => `<i style="background:${c}"><span>${i === 0 ? ends[0] : i === 4 ? ends[1] : ""}</span></i>`).join("") : "";
}

// Controls
const bounded = stops => Math.max(-12, Math.min(12, stops));
$("stops").addEventListener("input", () => { state.stops = Number($("stops").value); expose(); });
$("seconds").addEventListener("change", () => {
  const time = secondsOf($("seconds").value);
  if (time > 0) state.stops = bounded(Math.log2(time / facts.base_time));
  $("seconds").blur();
  expose();
});
$("tone").addEventListener("change", () => { $("whiteRow").hidden = !["reinhard", "filmic"].includes($("tone").value); paint(); });
$("white").addEventListener("input", paint);
$("frusta").addEventListener("change", () => drawn && frusta());
$("overlay").addEventListener("change", () => { legend(); nearestPhoto(); $("overlay").value === "clipped" ? moved() : paint(); });
$("left").addEventListener("change", () => { nearestPhoto(); $("left").value.startsWith("run") ? moved() : paint(); });
$("run").addEventListener("change", () => { useRun(Number($("run").value)); moved(); });
$("view").addEventListener("change", () => jump(Number($("view").value)));
$("zoom").addEventListener("input", moved);

$("handle").addEventListener("pointerdown", event => { event.stopPropagation(); $("handle").setPointerCapture(event.pointerId); });
$("handle").addEventListener("pointermove", event => {
  if (!event.buttons) return;
  const box = stage.getBoundingClientRect();
  state.split = Math.min(1, Math.max(0, (event.clientX - box.left) / box.width));
  paint();
});
const inside = event => {
  const box = stage.getBoundingClientRect();
  return [(event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height];
};
const fingers = new Map();
picture.addEventListener("pointerdown", event => {
  picture.setPointerCapture(event.pointerId);
  stage.focus();
  fingers.set(event.pointerId, [event.clientX, event.clientY]);
  state.drag = [event.clientX, event.clientY, 0];
});
for (const end of ["pointerup", "pointercancel"]) picture.addEventListener(end, event => fingers.delete(event.pointerId));
function pinch(event) {
  const before = [...fingers.values()];
  fingers.set(event.pointerId, [event.clientX, event.clientY]);
  camera.pinch(before, [...fingers.values()], Math.min(stage.clientWidth, stage.clientHeight));
  state.drag = [event.clientX, event.clientY, 99];
  moved();
}
picture.addEventListener("pointermove", event => {
  state.pointer = inside(event);
  if (fingers.size === 2 && fingers.has(event.pointerId)) return pinch(event);
  if (fingers.has(event.pointerId)) fingers.set(event.pointerId, [event.clientX, event.clientY]);
  if (state.drag && event.buttons) {
    const x = event.clientX - state.drag[0], y = event.clientY - state.drag[1], size = Math.min(stage.clientWidth, stage.clientHeight);
    state.drag = [event.clientX, event.clientY, state.drag[2] + Math.abs(x) + Math.abs(y)];
    camera.drag(event, x / size, y / size);
    if (x || y) moved();
  }
  probe();
});
picture.addEventListener("pointerup", event => {
  const still = state.drag && state.drag[2] < 4, ratio = window.devicePixelRatio || 1, box = stage.getBoundingClientRect();
  state.drag = null;
  if (still && state.picking) return pick(inside(event));
  const near = still && (state.apexes || []).find(([, x, y]) => Math.hypot(x / ratio - event.clientX + box.left, y / ratio - event.clientY + box.top) < 9);
  if (near) jump(near[0]);
});
picture.addEventListener("pointerleave", () => { state.pointer = null; probe(); });
picture.addEventListener("contextmenu", event => event.preventDefault());
picture.addEventListener("wheel", event => { camera.wheel(event); moved(); }, {passive: false});
picture.addEventListener("dblclick", event => {
  const target = pointAt(inside(event));
  if (state.picking || !target) return;
  camera.ahead = dot(add(target, camera.position, -1), camera.forward);
  const away = add(target, camera.pivot, -1);
  camera.position = add(camera.position, away);
  moved();
});
// Keys work at once, without a click into the picture first; what is typed into a field is its own.
const typing = target => target instanceof Element && target.matches("input, select, textarea");
document.addEventListener("keydown", event => {
  if (!facts || typing(event.target) || event.ctrlKey || event.metaKey) return;
  const key = event.key.toLowerCase(), count = facts.views.length;
  if ("wasdqe".includes(key)) { if (!state.keys.size) requestAnimationFrame(fly); state.keys.add(key); }
  if (key === "[" || key === "]") { state.stops = bounded(Math.round(3 * state.stops + (key === "]" ? 1 : -1)) / 3); expose(); }
  if (key === "home") home();
  if (count && (key === "arrowleft" || key === "arrowright")) jump((Number($("view").value) + (key === "arrowright" ? 1 : count - 1)) % count);
});
document.addEventListener("keyup", event => state.keys.delete(event.key.toLowerCase()));
window.addEventListener("blur", () => state.keys.clear());
// The surface under a place of the picture, or null.
function pointAt([u, v]) {
  const depth = drawn && light.value("depth", u, v);
  if (!depth || !(depth[0] > 0)) return null;
  const l = lensOf(drawn.camera), d = depth[0];
  return add(add(add(camera.position, camera.right, (u - l[2]) / l[0] * d), camera.down, (v - l[3]) / l[1] * d), camera.forward, d);
}
let flown = 0;
function fly(now) {
  const pace = facts.size * 0.25 * Math.min(0.1, flown ? (now - flown) / 1000 : 0.016), on = key => state.keys.has(key) ? pace : 0;
  flown = state.keys.size ? now : 0;
  if (!state.keys.size) return;
  camera.fly(on("d") - on("a"), on("e") - on("q"), on("w") - on("s"));
  moved();
  requestAnimationFrame(fly);
}

// Points that are picked measure lengths, set scale and up, and crop
const upright = point => { const m = facts.upright; return m ? [0, 1, 2].map(i => dot(m[i].slice(0, 3), point) + m[i][3]) : point; };
state.points = [];
function pick(place) {
  const point = pointAt(place);
  if (!point) return note("nothing is there to pick");
  if (state.points.length === 3) state.points = [];
  state.points.push(point);
  measured();
  frusta();
}
function measured() {
  const [a, b] = state.points.map(upright), length = b && Math.hypot(...add(b, a, -1));
  const scale = facts && facts.upright ? Math.hypot(...facts.upright[0].slice(0, 3)) : 1;
  // A unit of a scene is no length that anybody knows, until its scale was set.
  $("distance").textContent = length ? figure(length) + (Math.abs(scale - 1) > 1e-6 ? " m" : " units") : a ? a.map(figure).join(", ") : "";
  $("setScale").disabled = state.points.length !== 2;
  $("setUp").disabled = state.points.length !== 3;
  $("crop").disabled = $("cut").disabled = state.points.length !== 2;
  $("undo").disabled = !facts || !facts.edited;
}
function marks() {
  const context = drawing.getContext("2d"), ratio = window.devicePixelRatio || 1, scale = drawing.width / drawn.camera.width;
  const at = state.points.map(point => project(drawn.camera, point)).filter(Boolean).map(p => p.map(x => x * scale));
  context.strokeStyle = context.fillStyle = "#fff";
  context.lineWidth = 1.5 * ratio;
  context.beginPath();
  at.forEach(([x, y], i) => i ? context.lineTo(x, y) : context.moveTo(x, y));
  context.stroke();
  for (const [x, y] of at) { context.beginPath(); context.arc(x, y, 4 * ratio, 0, 7); context.fill(); }
}
const note = text => { $("edited").textContent = text; };
async function change(path, body, done) {
  note("\u2026");
  try {
    runs[state.run] = await (await ask(path, {run: state.run, ...body})).json();
    useRun(state.run);
    state.points = path === "edit" ? state.points : [];
    measured();
    note(done());
    moved();
    return true;
  } catch (error) { note(error.message); }
}
$("measure").addEventListener("click", () => {
  state.picking = !state.picking;
  $("measure").setAttribute("aria-pressed", state.picking);
  note(state.picking ? "click two points: a length, or a sphere; three: a level floor" : "");
});
$("setScale").addEventListener("click", () => {
  const meters = Number($("meters").value), [a, b] = state.points;
  if (!(meters > 0)) return note("type the true length in meters first");
  const scale = meters / Math.hypot(...add(b, a, -1));
  change("orientation", {scale}, () => `kept: ${figure(scale)} meters for each unit of the scene`);
});
$("setUp").addEventListener("click", () => {
  const [a, b, c] = state.points, normal = unit(cross(add(b, a, -1), add(c, a, -1)));
  const up = normal.map(x => x * (dot(normal, add(camera.position, a, -1)) < 0 ? -1 : 1));
  change("orientation", {up}, () => { camera.up = up; return "kept: files are upright by this floor"; });
});
// The first point is the center of a region, and the second lies on its rim: of a sphere, or of a box with equal sides.
function region({shape, points}) {
  const [a, b] = points.map(upright), offsets = add(b, a, -1), half = Math.max(...offsets.map(Math.abs));
  const values = shape === "box" ? [...a.map(x => x - half), ...a.map(x => x + half)] : [...a, Math.hypot(...offsets)];
  return `${shape}:${values.map(x => x.toPrecision(5)).join(",")}`;
}
let editing = Promise.resolve();  // One edit after the other
const queued = change => { editing = editing.then(change); };
// The server has the edits of the run, for all of its pages: the last one is shown, and Undo goes back by one.
async function put(part) {
  note("\u2026");
  await renew();
  return edit([...facts.history, {...facts.history.at(-1), ...part}]);
}
for (const name of ["crop", "cut"]) $(name).addEventListener("click", () => {
  const drawn = {shape: $("shape").value, points: [...state.points]};
  queued(() => put({[name]: drawn}));
});
$("floaters").addEventListener("click", () => queued(() => put({min_views: 2})));
$("unmasked").addEventListener("click", () => queued(() => put({mask_only: true})));
$("faint").addEventListener("change", () => queued(() => put({min_opacity: Number($("faint").value)})));
$("merge").addEventListener("change", () => {
  const index = Number($("merge").value);
  $("merge").value = "";
  queued(() => put({merge: [...facts.history.at(-1).merge || [], index]}));
});
// Shows what is left to choose after an edit.
function offer() {
  const {min_opacity, merge} = facts.history.at(-1);
  $("faint").value = min_opacity || 0;
  [...$("merge").options].slice(1).forEach((option, i) => { option.disabled = i === state.run || (merge || []).includes(i); });
}
$("undo").addEventListener("click", () => queued(async () => {
  note("\u2026");
  await renew();
  return edit(facts.history.length > 1 ? facts.history.slice(0, -1) : [{}]);
}));
const asOptions = edits => Object.fromEntries(Object.entries(edits).map(([name, value]) => [name, value.points ? region(value) : value]));
async function edit(history) {
  if (!await change("edit", {...asOptions(history.at(-1)), history}, description)) offer();  // As where nothing would be left
}
function description() {
  const words = value => value === true ? "" : " " + (Array.isArray(value) ? value.map(i => runs[i].argument).join(" ") : value);
  const flags = Object.entries(asOptions(facts.history.at(-1))).map(([name, value]) => ` --${name.replace("_", "-")}` + words(value)).join("");
  return flags ? `${counts(facts.gaussians)} Gaussians; sehdr-warp export ${facts.argument} --out part.ply${flags}` : "all of it is shown";
}
measured();

// Lights: a list to fly to, with a gain for each
function listLights(list) {
  const unit = list && list.unit, value = x => unit ? `${figure(unit * x)} cd/m\u00b2` : figure(x);
  $("lightList").replaceChildren(...(list ? list.lights : []).map((lamp, i) => {
    const make = (kind, values = {}) => Object.assign(document.createElement(kind), values), row = make("div", {className: "light"});
    const name = `${lamp.name}: ${(100 * lamp.share).toFixed(lamp.share < 0.1 ? 1 : 0)} % of the light`;
    const sure = lamp.deviation === null ? "" : ` \u00b1 ${lamp.deviation.toFixed(1)} stops`, button = make("button", {textContent: name, title: "fly there"});
    const range = make("input", {type: "range", min: -6, max: 6, step: 0.1, value: lamp.stops, ariaLabel: `gain of ${lamp.name}, stops`});
    const stops = make("output", {textContent: stopsText(lamp.stops)});
    const words = `${value(lamp.radiance)}${sure}, at least ${value(lamp.certain)}`, title = "radiance, the deviation of its estimate, and what the photos prove";
    row.append(button, stops, make("span", {className: "quiet", textContent: words, title}), range);
    button.addEventListener("click", () => flyTo(lamp));
    range.addEventListener("input", () => { stops.textContent = stopsText(Number(range.value)); });
    range.addEventListener("change", () => gain(i, Number(range.value)));
    return row;
  }));
  $("lightNote").textContent = list && !list.lights.length ? "the photos clip no light" : "";
}
// From the side of the photos: five times its size away from a large light, at three tenths of the distance from a small one.
function flyTo(lamp) {
  const places = facts.views.map(view => centerOf(view.camera)), middle = places[0] ? [0, 1, 2].map(i => places.reduce((sum, p) => sum + p[i], 0) / places.length) : camera.position;
  const away = add(middle, lamp.position, -1), distance = Math.hypot(...away), near = Math.min(0.9 * distance, Math.max(5 * lamp.size, 0.3 * distance));
  camera.face(add(lamp.position, away, near / (distance || 1)), lamp.position);
  moved();
}
async function gain(light, stops) {
  try {
    await ask("gain", {run: state.run, light, stops});
    moved();
  } catch (error) { $("lightNote").textContent = error.message; }
}
$("findLights").addEventListener("click", async () => {
  $("lightNote").textContent = "\u2026";
  try { listLights(await (await ask("lights", {run: state.run})).json()); } catch (error) { $("lightNote").textContent = error.message; }
});
$("asPhoto").addEventListener("click", () => {
  const view = facts.views[Number($("view").value)];
  if (view) { state.stops = bounded(Math.log2(view.time / facts.base_time)); expose(); }
});

// Saving and films
const filmSize = () => [Math.round(drawing.width / 2) * 2, Math.round(drawing.height / 2) * 2];
const now = () => camera.at(...filmSize(), zoom());
function download(blob, name) {
  const link = Object.assign(document.createElement("a"), {href: URL.createObjectURL(blob), download: name});
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10000);
}
const answer = text => { $("saved").textContent = text, $("saved").scrollIntoView({block: "nearest"}); };
const frameCount = () => Math.max(2, Math.round(24 * (Number($("length").value) || 6)));
for (const button of document.querySelectorAll("[data-save]")) button.addEventListener("click", async () => {
  const kind = button.dataset.save, film = kind === "film";
  if (film && state.path.length < 2) return answer("add two views or more first");
  answer(kind === "page" ? "fitting colors for the page, up to a minute \u2026" : "rendering \u2026");
  let watch = film && setInterval(async () => {
    const line = await ask("saving").then(reply => reply.text(), () => "");
    if (line && watch) answer(line);
  }, 1000);
  try {
    const body = {run: state.run, kind, evs: $("evs").value, cameras: film ? state.path : [now()], count: film ? frameCount() : null, stops: state.stops};
    download(await (await ask("save", body)).blob(), facts.scene + {exr: ".exr", brackets: "_brackets.zip", film: ".mp4", page: ".html"}[kind]);
    answer("saved by your browser");
  } catch (error) { answer(error.message); }
  watch = clearInterval(watch);
});
$("addView").addEventListener("click", () => { state.path.push(now()); answer(`${state.path.length} views in the path`); });
$("clearPath").addEventListener("click", () => { state.path = []; playing = 0; answer(""); });
const path = async () => (await (await ask("path", {cameras: state.path, count: frameCount()})).json()).cameras;
$("savePath").addEventListener("click", async () => {
  if (!state.path.length) return answer("add a view first");
  download(new Blob([JSON.stringify({cameras: await path()})], {type: "application/json"}), "path.json");
  answer("render it: sehdr-warp render RUN --cameras path.json --video film.mp4");
});
$("play").addEventListener("click", async () => {
  if (state.path.length < 2) return answer("add two views or more first");
  const cameras = await path(), turn = ++playing, started = performance.now(), step = async () => {
    const index = Math.floor((performance.now() - started) / 1000 * 24);
    if (turn !== playing) return;
    camera.jump(cameras[Math.min(index, cameras.length - 1)], {size: 2 * camera.ahead});
    $("zoom").value = 0;
    if (index >= cameras.length) return moved();
    await request(true);
    requestAnimationFrame(step);
  };
  step();
});

// Training
async function startTraining() {
  $("training").hidden = false;
  const control = name => ask("training", {do: name}).catch(error => tell(error.message));
  $("pause").addEventListener("click", () => control($("pause").textContent === "Pause" ? "pause" : "resume"));
  $("step").addEventListener("click", () => control("step"));
  let last = -1, ended = false;
  while (!ended) {
    try {
      const t = await (await ask("training")).json();
      if (t.iteration === undefined) throw new Error("not yet");
      ended = t.ended;
      $("progress").textContent = `${t.iteration} of ${t.total} \u00b7 loss ${t.loss?.toFixed(4) ?? "none"} \u00b7 ${t.psnr?.toFixed(1) ?? "no"} dB \u00b7 ${counts(t.gaussians)} Gaussians`
        + (ended || t.left === null ? "" : ` \u00b7 ${t.left} left`) + ` \u00b7 ${(100 * t.share).toFixed(0)} % for pictures`;
      $("pause").textContent = t.paused ? "Resume" : "Pause";
      facts.gaussians = t.gaussians;
      curve(t.curve);
      if (t.iteration !== last && !document.hidden && !ended) request(false);
      last = t.iteration;
    } catch (error) {
      ended = error.message !== "not yet";
      if (!ended) $("progress").textContent = "kernels are being compiled";
    }
    await new Promise(done => setTimeout(done, 1000));
  }
  $("pause").disabled = $("step").disabled = true;
  tell(over());
}
function curve(points) {
  const context = $("curves").getContext("2d");
  context.clearRect(0, 0, 248, 86);
  [["loss", "#e0a458"], ["PSNR", "#7fb2c4"], ["Gaussians", "#8a8783"]].forEach(([name, color], k) => {
    const values = points.map(p => p[k + 1]).filter(Number.isFinite), low = Math.min(...values), high = Math.max(...values);
    context.strokeStyle = context.fillStyle = color;
    context.lineWidth = 1.5;
    context.beginPath();
    points.forEach((p, i) => context.lineTo(i / Math.max(1, points.length - 1) * 247, 70 - 60 * ((p[k + 1] ?? NaN) - low) / (high - low || 1)));
    context.stroke();
    context.font = "10px system-ui";
    context.fillText(name, k * 84, 84);
  });
}

window.viewer = {state, probed: () => state.probed, camera: () => drawn && drawn.camera};
start().catch(error => tell(error.message));
