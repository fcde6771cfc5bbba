// The camera that flies: OpenCV axes, an orbit about a point ahead.
"use strict";

const add = (a, b, t = 1) => a.map((x, i) => x + t * b[i]);
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = a => { const l = Math.hypot(...a) || 1; return a.map(x => x / l); };
function turned(v, axis, angle) {  // Rodrigues
  const c = Math.cos(angle), s = Math.sin(angle), w = cross(axis, v), d = dot(axis, v) * (1 - c);
  return v.map((x, i) => x * c + w[i] * s + axis[i] * d);
}

// Of pictures from the place of a panorama or a fisheye photo, which are perspective: 75 degrees of the shorter side.
const WIDE_PHOTO_LENS = {width: 2, height: 2, fx: 1 / Math.tan(0.6545), fy: 1 / Math.tan(0.6545), cx: 1, cy: 1};

class FlyingCamera {
  constructor(up) { this.up = unit(up); }

  // Takes a camera's place; an orbit turns about a point ahead, at the focus of the scene or half its size away.
  jump(camera, {focus, size}) {
    const m = camera.world_to_camera, ahead = focus ? dot(add(focus, centerOf(camera), -1), m[2].slice(0, 3)) : 0;
    this.lens = camera.projection ? WIDE_PHOTO_LENS : camera, this.ahead = ahead > 0 ? ahead : size / 2;
    this.right = m[0].slice(0, 3), this.down = m[1].slice(0, 3), this.forward = m[2].slice(0, 3);
    this.position = centerOf(camera);
  }
  get pivot() { return add(this.position, this.forward, this.ahead); }
  turn(axis, angle) {
    for (const name of ["right", "down", "forward"]) this[name] = turned(this[name], axis, angle);
    this.right = unit(this.right), this.forward = unit(add(this.forward, this.right, -dot(this.forward, this.right)));
    this.down = cross(this.forward, this.right);
  }
  orbit(x, y) {
    const about = this.pivot;
    this.look(x, y);
    this.position = add(about, this.forward, -this.ahead);
  }
  look(x, y) {
    this.turn(this.up, -x);
    const tilt = Math.asin(Math.max(-1, Math.min(1, dot(this.forward, this.up))));
    this.turn(this.right, Math.max(-1.5 - tilt, Math.min(1.5 - tilt, -y)));  // Not over the poles
  }
  pan(x, y) { this.position = add(add(this.position, this.right, -x * this.ahead), this.down, -y * this.ahead); }
  dolly(factor) {
    const about = this.pivot;
    this.ahead *= factor;
    this.position = add(about, this.forward, -this.ahead);
  }
  // Moves by what a pointer does to a picture: a drag by x and y, parts of its size, and a turn of the wheel.
  drag(event, x, y) {
    if (event.buttons & 6 || event.shiftKey) this.pan(x, y);
    else if (event.altKey) this.look(-x, -y);
    else this.orbit(2.5 * x, 2.5 * y);
  }
  wheel(event) {
    event.preventDefault();
    this.dolly(Math.exp(Math.sign(event.deltaY) * Math.min(60, Math.abs(event.deltaY)) / 500));
  }
  // Two fingers at two places before and after: their distance moves nearer and away, their middle pans.
  pinch(before, after, size) {
    const apart = ([a, b]) => Math.max(1, Math.hypot(a[0] - b[0], a[1] - b[1]));
    const [from, to] = [before, after].map(([a, b]) => [(a[0] + b[0]) / 2, (a[1] + b[1]) / 2]);
    this.dolly(apart(before) / apart(after));
    this.pan((to[0] - from[0]) / size, (to[1] - from[1]) / size);
  }
  // Stands at a place and looks at another, upright.
  face(place, target) {
    const away = add(target, place, -1), ahead = Math.hypot(...away), forward = unit(away), side = cross(forward, this.up);
    this.position = place, this.ahead = ahead, this.forward = forward;
    this.right = unit(Math.hypot(...side) > 1e-3 ? side : this.right), this.down = cross(forward, this.right);
  }
  fly(right, up, forward) {
    this.position = add(add(add(this.position, this.right, right), this.down, -up), this.forward, forward);
  }
  // As the server takes it, for a picture of so many pixels; the photo's frame fits into it. zoom: factor of the lens.
  at(width, height, zoom = 1) {
    const l = this.lens, s = zoom * Math.min(width / l.width, height / l.height), p = this.position;
    const rows = [this.right, this.down, this.forward].map(axis => [...axis, -dot(axis, p)]);
    return {width, height, fx: l.fx * s, fy: l.fy * s, cx: width / 2 + (l.cx - l.width / 2) * s,
            cy: height / 2 + (l.cy - l.height / 2) * s, world_to_camera: [...rows, [0, 0, 0, 1]]};
  }
}

// Returns request(draft), which calls render(draft) once the last picture is done; of requests meanwhile one remains, a
// full one if any was.
function requester(render) {
  const request = async draft => {
    request.wanted = request.wanted === null ? draft : request.wanted && draft;
    if (request.busy) return;
    request.busy = true;
    while (request.wanted !== null) {
      const next = request.wanted;
      request.wanted = null;
      await render(next);
    }
    request.busy = false;
  };
  return Object.assign(request, {wanted: null, busy: false});
}

// Row by row, the 4 x 4 matrix from one camera's coordinates to another's.
function between(from, to) {
  const a = from.world_to_camera, b = to.world_to_camera;
  const center = [0, 1, 2].map(i => -(a[0][i] * a[0][3] + a[1][i] * a[1][3] + a[2][i] * a[2][3]));
  return b.slice(0, 3).flatMap(row => [...[0, 1, 2].map(j => dot(row, a[j])), dot(row, center) + row[3]]).concat([0, 0, 0, 1]);
}
const lensOf = c => [c.fx / c.width, c.fy / c.height, c.cx / c.width, c.cy / c.height];
// A photo's projection for LightCanvas: 0 pinhole, 1 panorama, 2 fisheye, with its distortion k1 to k4 and widest angle.
function projectionOf(c) {
  if (!c.projection || c.projection === "equirectangular") return {projection: c.projection ? 1 : 0};
  const distortion = [0, 1, 2, 3].map(i => c.distortion[i] || 0), steps = 2048;
  const radius = t => t * (1 + distortion.reduce((sum, k, i) => sum + k * t ** (2 * i + 2), 0));
  const angles = [...Array(steps).keys()].map(i => i / (steps - 1) * Math.PI), last = angles.findIndex((t, i) => i && radius(t) <= radius(angles[i - 1]));
  return {projection: 2, distortion, widestAngle: last < 0 ? 4 : angles[last - 1]};
}
function project(camera, point) {  // Pixels, or null behind
  const m = camera.world_to_camera, [x, y, z] = [0, 1, 2].map(i => dot(m[i], point) + m[i][3]);
  return z > 1e-6 ? [camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy] : null;
}
function centerOf(camera) {
  const m = camera.world_to_camera;
  return [0, 1, 2].map(i => -(m[0][i] * m[0][3] + m[1][i] * m[1][3] + m[2][i] * m[2][3]));
}
