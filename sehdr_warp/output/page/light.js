// Scene-linear light on a canvas: half floats in, exposure, tone map and overlays in one WebGL2 shader. Only uniforms move
// with the exposure. Shared by the viewer, the report and notebooks.
"use strict";

const TONES = ["none", "reinhard", "filmic", "aces", "response"];
const OVERLAYS = ["none", "stops", "confidence", "depth", "normals", "error", "clipped"];
const TABLED = ["none", "stops", "clipped"];  // Overlays that an exposure changes
const TEXTURES = ["scene", "other", "depth", "clipped", "photo", "curve"];
const CURVE_LOW = -20, CURVE_HIGH = 20, CURVE_SIZE = 1024;  // Stops that a response's table spans

const VERTEX = `#version 300 es
out vec2 at;
void main() {
  at = vec2(gl_VertexID & 1, gl_VertexID >> 1) * 2.0;
  gl_Position = vec4(at * 2.0 - 1.0, 0, 1);
}`;

// Looks are constants of a program, compiled when first used: software renderers pay for every branch there is.
const FRAGMENT = looks => `#version 300 es
const int ${Object.entries(looks).map(([name, value]) => `${name} = ${value}`).join(", ")};
precision highp float;
precision highp sampler2D;
in vec2 at;
out vec4 color;
uniform sampler2D scene, other, depth, clipped, photo, curve;
uniform float gain, grey, white, split, near, far;
uniform mat4 toPhoto;                        // camera of the view to camera of the photo
uniform vec4 lens, photoLens;                // fx, fy, cx, cy over width and height
uniform vec4 distortion;                     // k1 to k4 of a fisheye photo
uniform float widestAngle;                   // its widest angle from the axis

// tone and overlay: of the lists above. left of the split: 0 scene, 1 other, 2 photo. projection of the photo: 0 pinhole, 1 panorama, 2 fisheye
const vec3 LUMINANCE = vec3(0.2126, 0.7152, 0.0722);

vec3 srgb(vec3 x) {
  x = clamp(x, 0.0, 1.0);
  return mix(12.92 * x, 1.055 * pow(max(x, 1e-9), vec3(1.0 / 2.4)) - 0.055, step(0.0031308, x));
}
vec3 reinhard(vec3 x) {                      // Reinhard et al. 2002, Eq. 4, mixed of luminance and channels
  float l = dot(x, LUMINANCE), shown = l * (1.0 + l / (white * white)) / (1.0 + l);
  vec3 each = x * (1.0 + x / (white * white)) / (1.0 + x);
  return mix(x * shown / max(l, 1e-9), each, min(shown, 1.0));
}
vec3 hable(vec3 x) {                         // Hable 2010
  return (x * (0.15 * x + 0.05) + 0.004) / (x * (0.15 * x + 0.5) + 0.06) - 0.02 / 0.3;
}
vec3 aces(vec3 x) {                          // Hill's fit of the ACES reference and sRGB output transforms
  const mat3 into = mat3(0.59719, 0.07600, 0.02840, 0.35458, 0.90834, 0.13383, 0.04823, 0.01566, 0.83777);
  const mat3 back = mat3(1.60475, -0.10208, -0.00327, -0.53108, 1.10813, -0.07276, -0.07367, -0.00605, 1.07602);
  x = into * x;
  return back * ((x * (x + 0.0245786) - 0.000090537) / (x * (0.983729 * x + 0.4329510) + 0.238081));
}
vec3 response(vec3 x) {
  vec3 place = (log2(max(x, 1e-9)) - float(${CURVE_LOW})) / float(${CURVE_HIGH - CURVE_LOW});
  place = (clamp(place, 0.0, 1.0) * float(${CURVE_SIZE - 1}) + 0.5) / float(${CURVE_SIZE});
  return vec3(texture(curve, vec2(place.r, 0.5)).r, texture(curve, vec2(place.g, 0.5)).r,
              texture(curve, vec2(place.b, 0.5)).r);
}
vec3 shown(vec3 light) {
  vec3 x = max(light, 0.0) * gain;
  if (tone == 4) return response(x);
  x *= grey;
  if (tone == 1) return srgb(reinhard(x));
  if (tone == 2) return srgb(hable(2.0 * x) / hable(vec3(white)));
  if (tone == 3) return srgb(aces(x * 1.8));
  return srgb(x);
}
vec3 ramp(float t) {                         // Dark blue over green to yellow
  t = clamp(t, 0.0, 1.0);
  vec3 low = mix(vec3(0.10, 0.09, 0.22), vec3(0.13, 0.42, 0.55), min(t * 2.0, 1.0));
  return mix(low, vec3(0.98, 0.88, 0.35), max(t * 2.0 - 1.0, 0.0));
}
vec3 stops(float l) {                        // Bands of a stop about middle grey, which is grey
  float s = floor(l + 0.5);
  if (s == 0.0) return vec3(0.5);
  float t = min(abs(s) / 8.0, 1.0);
  if (s < 0.0) return mix(vec3(0.25, 0.62, 0.72), vec3(0.16, 0.04, 0.32), t);
  return s < 4.0 ? mix(vec3(0.45, 0.70, 0.35), vec3(0.95, 0.85, 0.25), s / 3.0)
                 : mix(vec3(0.95, 0.55, 0.15), vec3(0.85, 0.08, 0.12), min((s - 4.0) / 4.0, 1.0));
}
vec3 place(vec2 uv) {                        // Of what a pixel shows, in the camera
  return vec3((uv - lens.zw) / lens.xy, 1.0) * texture(depth, uv).r;
}
bool photographed(vec2 uv, out vec3 photoColor) {  // What the photo shows of that place
  vec3 p = place(uv);
  vec3 q = (toPhoto * vec4(p.z > 0.0 ? p : vec3((uv - lens.zw) / lens.xy, 1.0) * far, 1.0)).xyz;
  vec2 on = q.xy / q.z * photoLens.xy + photoLens.zw;
  bool within = q.z > 0.0;
  if (projection == 1) {                     // A panorama
    on = vec2(0.5 + atan(q.x, q.z) / 6.28318531, 0.5 + asin(clamp(q.y / max(length(q), 1e-12), -1.0, 1.0)) / 3.14159265);
    within = true;
  }
  if (projection == 2) {                     // A fisheye lens
    float angle = atan(length(q.xy), q.z), a = angle * angle;
    on = q.xy / max(length(q.xy), 1e-12) * angle * (1.0 + a * (distortion.x + a * (distortion.y + a * (distortion.z + a * distortion.w))));
    on = on * photoLens.xy + photoLens.zw;
    within = angle < widestAngle;
  }
  photoColor = texture(photo, on).rgb;
  return within && all(greaterThan(on, vec2(0.0))) && all(lessThan(on, vec2(1.0)));
}
void main() {
  vec2 uv = vec2(at.x, 1.0 - at.y);
  vec3 photoColor;
  vec4 light = texture(scene, uv);
  if (at.x < split && left == 1) light = texture(other, uv);
  color = vec4(shown(light.rgb), 1);
  if (at.x < split && left == 2) {
    color.rgb = photographed(uv, photoColor) ? photoColor : vec3(0.1);
    return;
  }
  if (overlay == 1) color.rgb = stops(log2(max(dot(light.rgb, LUMINANCE) * gain * grey, 1e-9) / 0.18));
  if (overlay == 2) color.rgb = ramp(light.a);
  if (overlay == 3) color.rgb = texture(depth, uv).r > 0.0 ? ramp((near * far / texture(depth, uv).r - near) / max(far - near, 1e-9)) : vec3(0.0);
  if (overlay == 4) {
    vec2 size = vec2(textureSize(depth, 0)), e = ceil(size.y / 400.0) / size;  // Finer is the Gaussians' own relief.
    vec3 n = cross(place(uv + vec2(0, e.y)) - place(uv - vec2(0, e.y)), place(uv + vec2(e.x, 0)) - place(uv - vec2(e.x, 0)));
    color.rgb = 0.5 + 0.5 * n * vec3(1, -1, -1) / max(length(n), 1e-12);
  }
  if (overlay == 5) {
    bool inside = photographed(uv, photoColor);
    vec3 off = abs(photoColor - response(max(light.rgb, 0.0)));
    color.rgb = inside ? ramp(max(off.r, max(off.g, off.b)) * 4.0) : vec3(0.08);
  }
  if (overlay == 6) color.rgb = mix(vec3(dot(color.rgb, LUMINANCE)) * 0.6, vec3(1.0, 0.25, 0.15), texture(clipped, uv).r);
}`;

// Of a half float's bits, its value.
const HALVES = Float32Array.from({length: 65536}, (_, h) => {
  const exponent = h >> 10 & 31, fraction = h & 1023, sign = h & 0x8000 ? -1 : 1;
  if (exponent === 31) return fraction ? NaN : sign * Infinity;
  return sign * (exponent ? 2 ** (exponent - 15) * (1 + fraction / 1024) : 2 ** -14 * fraction / 1024);
});
const fromHalf = h => HALVES[h];
const QUICK = 12, PAUSE = 150;  // Milliseconds: of a draw while looks move, in software; and without one until they rest

const software = gl => /swiftshader|llvmpipe|softpipe|software|basic render/i.test(
  gl.getParameter((gl.getExtension("WEBGL_debug_renderer_info") || {UNMASKED_RENDERER_WEBGL: gl.RENDERER}).UNMASKED_RENDERER_WEBGL));

// Where WebGL is software its canvas is not the one in the page. What an exposure changes are tables there (tables.js),
// which take a tenth of the time; the shader draws the rest once. What takes longer than QUICK is coarser while it moves.
// Without WebGL2 (`gl` is null) there are the tables alone.
class LightCanvas {
  constructor(canvas) {
    const probe = document.createElement("canvas"), options = {antialias: false, preserveDrawingBuffer: true};
    let gl = probe.getContext("webgl2", options);
    if (!gl || software(gl)) this.paper = canvas.getContext("2d", {alpha: false});
    else gl = canvas.getContext("webgl2", options);
    this.canvas = canvas, this.gl = gl, this.textures = {}, this.frames = {}, this.programs = {}, this.stale = new Set();
    this.drawn = -Infinity, this.scale = this.wide = 1, this.changes = 0;
    this.settings = {stops: 0, tone: "none", white: 4, overlay: "none", split: 0, left: 0, grey: 1, near: 1, far: 1,
                     toPhoto: [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1], lens: [1, 1, .5, .5], photoLens: [1, 1, .5, .5], projection: 0, distortion: [0, 0, 0, 0], widestAngle: 0};
    if (!gl) return;
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
    TEXTURES.forEach((name, unit) => {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(gl.TEXTURE_2D, this.textures[name] = gl.createTexture());
      for (const side of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, side, gl.CLAMP_TO_EDGE);
      for (const size of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, size, gl.LINEAR);
      gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, 1, 1, 0, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
    });
  }

  program(looks) {
    const gl = this.gl, key = JSON.stringify(looks);
    if (this.programs[key]) return this.programs[key];
    const program = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT(looks)]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    gl.useProgram(program);
    TEXTURES.forEach((name, unit) => gl.uniform1i(gl.getUniformLocation(program, name), unit));
    return this.programs[key] = {program, places: {}};
  }

  // Half floats (Uint16Array) of 1, 3 or 4 channels, top row first, for the texture of a name.
  put(name, width, height, half, channels) {
    this.frames[name] = {width, height, half, channels};
    this.stale.add(name);
    this.changes++;
  }

  // A response's table in base64: the look of the tone "response".
  putCurve(text) {
    const bytes = Uint8Array.from(atob(text), c => c.charCodeAt(0));
    this.put("curve", CURVE_SIZE, 1, new Uint16Array(bytes.buffer), 1);
  }

  upload(name, {width, height, half, channels}) {
    const gl = this.gl;
    const [inside, format] = {1: [gl.R16F, gl.RED], 3: [gl.RGB16F, gl.RGB], 4: [gl.RGBA16F, gl.RGBA]}[channels];
    gl.activeTexture(gl.TEXTURE0 + TEXTURES.indexOf(name));
    const filter = width === this.canvas.width && height === this.canvas.height ? gl.NEAREST : gl.LINEAR;
    for (const size of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, size, filter);
    gl.texImage2D(gl.TEXTURE_2D, 0, inside, width, height, 0, format, gl.HALF_FLOAT, half);
  }

  putPhoto(image) {
    const gl = this.gl;
    if (!gl) return;
    gl.activeTexture(gl.TEXTURE0 + TEXTURES.indexOf("photo"));
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, gl.RGBA, gl.UNSIGNED_BYTE, image);
    this.changes++;
  }

  draw(changes = {}) {
    const s = Object.assign(this.settings, changes), {width, height} = this.canvas, fits = name => {
      const f = this.frames[name];
      return f && f.width === width && f.height === height;
    };
    clearTimeout(this.rest);
    if (!this.paper) return this.shade(s, width, height);
    const before = performance.now(), moving = before - this.drawn < PAUSE, exposed = TABLED.includes(s.overlay);
    const tables = exposed && ["scene", ...s.left === 1 ? ["other"] : [], ...s.overlay === "clipped" ? ["clipped"] : []].every(fits);
    if (!tables && !this.gl) return;
    const edge = s.left ? Math.round(s.split * width) : 0, unexposed = {stops: 0, tone: "none", white: 4};
    // With tables the shader draws the photo alone, over all of the width, of which an edge shows its part.
    const shaded = tables ? {...s, ...unexposed, overlay: "none", split: 1} : exposed ? s : {...s, ...unexposed};
    this.coarse = this.shadeOnce(shaded, width, height, moving, !tables ? width : s.left === 2 ? edge : 0);
    if (tables) this.coarse = this.lookUp(width, height, moving, edge) || this.coarse;
    this.drawn = performance.now();
    if (this.coarse) this.rest = setTimeout(() => this.draw(), PAUSE);
  }

  // By the shader, the columns to `edge` if they have changed, in fewer pixels while looks move; returns whether they are fewer.
  shadeOnce(settings, width, height, moving, edge) {
    const before = performance.now(), key = JSON.stringify([settings, width, height, this.changes]), scale = moving ? this.scale : 1;
    const known = this.shaded && this.shaded.key === key && this.shaded.scale >= scale;
    if (!edge || known && this.shaded.edge === edge) return edge && this.shaded.scale < 1;
    if (!known) this.shaded = {key, scale};
    this.shaded.edge = edge;
    const [w, h] = [width, height].map(side => Math.max(1, Math.round(side * this.shaded.scale)));
    if (!known) this.shade(settings, w, h);
    const inset = this.shaded.scale < 1 ? 0.5 : 0, part = edge / width;  // Enlarging would take in what an earlier draw left beside it.
    this.paper.drawImage(this.gl.canvas, inset, this.gl.canvas.height - h + inset, (w - 2 * inset) * part, h - 2 * inset, 0, 0, edge, height);
    if (!known) this.scale = Math.min(1, Math.max(0.25, scale * Math.sqrt(QUICK / Math.max(1, performance.now() - before))));
    return this.shaded.scale < 1;
  }

  // By the shader, into the lower left corner of WebGL's canvas.
  shade(s, width, height) {
    const gl = this.gl, canvas = gl.canvas;
    for (const name of this.stale) this.upload(name, this.frames[name]);
    this.stale.clear();
    if (this.paper && (canvas.width < width || canvas.height < height)) canvas.width = Math.max(width, canvas.width), canvas.height = Math.max(height, canvas.height);
    const comparesPhoto = s.left === 2 || s.overlay === "error";
    const chosen = {tone: TONES.indexOf(s.tone), overlay: OVERLAYS.indexOf(s.overlay), left: s.left, projection: comparesPhoto ? s.projection : 0};
    const {program, places} = this.program(chosen), at = name => places[name] ??= gl.getUniformLocation(program, name);
    gl.useProgram(program);
    for (const [name, value] of Object.entries({gain: 2 ** s.stops, grey: s.grey, white: s.white, split: s.split, near: s.near, far: s.far, widestAngle: s.widestAngle}))
      gl.uniform1f(at(name), value);
    gl.uniform4fv(at("lens"), s.lens);
    gl.uniform4fv(at("photoLens"), s.photoLens);
    gl.uniform4fv(at("distortion"), s.distortion);
    gl.uniformMatrix4fv(at("toPhoto"), true, s.toPhoto);
    gl.viewport(0, 0, width, height);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  // By tables, over the frames in memory: every pixel, or while looks move one of so many that are wide alike.
  lookUp(width, height, moving, edge) {
    const s = this.settings, before = performance.now(), first = s.left === 2 ? edge : 0;
    this.tables ??= new LookTables();
    this.tables.set(s, this.frames);
    if (!this.image || this.image.width !== width || this.image.height !== height) this.image = new ImageData(width, height);
    const pixels = new Uint32Array(this.image.data.buffer), wide = moving ? this.wide : 1;
    const prepared = [["other", first, edge], ["scene", edge, width]].filter(([, first, last]) => first < last)
      .map(([name, first, last]) => this.tables.fill(this.frames[name], pixels, first, last, wide)).some(Boolean);
    if (first < width) this.paper.putImageData(this.image, 0, 0, first, 0, width - first, height);
    if (this.shaded) this.shaded.edge = Math.min(this.shaded.edge, first);  // What lay there is gone.
    if (!prepared) this.wide = Math.min(4, wide + 1, Math.ceil(0.8 * wide * (performance.now() - before) / QUICK));
    return wide > 1;
  }

  // The channels of a texture at a place, 0 to 1 from the left and the top.
  value(name, x, y) {
    const f = this.frames[name];
    if (!f || !(x >= 0 && x < 1 && y >= 0 && y < 1)) return null;
    const first = (Math.floor(y * f.height) * f.width + Math.floor(x * f.width)) * f.channels;
    return Array.from(f.half.subarray(first, first + f.channels), fromHalf);
  }
}

const luminance = ([r, g, b]) => 0.2126 * r + 0.7152 * g + 0.0722 * b;
const stopsText = stops => (Math.abs(stops) < 0.05 ? "" : stops < 0 ? "\u2212" : "+") + Math.abs(stops).toFixed(1) + " EV";
const secondsText = time => time < 0.3 ? `1/${Number((1 / time).toPrecision(time < 0.01 ? 3 : 2))} s` : `${Number(time.toPrecision(3))} s`;

// Deflated half floats in base64, as the report and notebooks carry them.
async function unpackLight(text) {
  const raw = atob(text), bytes = new Uint8Array(raw.length);
  for (let i = 0; i < raw.length; i++) bytes[i] = raw.charCodeAt(i);
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint16Array(await new Response(stream).arrayBuffer());
}

// A dial: <div class="dial"> with a canvas, a range, an output, and for each picture a <script type="text/plain">.
async function startDial(dial) {
  const canvas = dial.querySelector("canvas"), range = dial.querySelector("input"), label = dial.querySelector("output");
  const set = dial.dataset, lights = {};
  for (const each of dial.querySelectorAll("script[data-light]")) lights[each.dataset.light] = await unpackLight(each.textContent);
  const view = new LightCanvas(canvas);
  const width = Number(set.width), height = Number(set.height), names = Object.keys(lights);
  const show = (texture, name) => view.put(texture, width, height, lights[name], 3);
  const draw = () => {
    view.draw({stops: Number(range.value)});
    const time = Number(set.time) * 2 ** Number(range.value);
    label.textContent = `${stopsText(Number(range.value))} \u00b7 ${secondsText(time)}`;
  };
  const sides = dial.querySelectorAll("select"), textures = ["other", "scene"];
  sides.forEach((side, i) => side.addEventListener("change", () => { show(textures[i], side.value); draw(); }));
  const split = dial.querySelector(".split");
  const move = event => {
    const box = canvas.getBoundingClientRect(), x = Math.min(1, Math.max(0, (event.clientX - box.left) / box.width));
    view.draw({split: x});
    if (split) split.style.left = 100 * x + "%";
  };
  if (names.length > 1) {
    canvas.addEventListener("pointerdown", event => { canvas.setPointerCapture(event.pointerId); move(event); });
    canvas.addEventListener("pointermove", event => event.buttons && move(event));
    show("other", sides[0] ? sides[0].value : names[0]);
  }
  show("scene", sides[1] ? sides[1].value : names[0]);
  view.draw({grey: Number(set.grey), left: 1, split: names.length > 1 ? 0.5 : 0});
  range.addEventListener("input", draw);
  draw();
}
