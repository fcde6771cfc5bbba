// Looks that move with the exposure as tables, for a processor instead of WebGL. What costs much is done once for a frame or a white point, so
// that an exposure costs a few look-ups a pixel.
"use strict";

const srgb = x => x <= 0.0031308 ? 12.92 * x : 1.055 * x ** (1 / 2.4) - 0.055;
const hable = x => (x * (0.15 * x + 0.05) + 0.004) / (x * (0.15 * x + 0.5) + 0.06) - 0.02 / 0.3;
const fitted = x => (x * (x + 0.0245786) - 0.000090537) / (x * (0.983729 * x + 0.4329510) + 0.238081);
const byte = x => 255 * Math.min(1, Math.max(0, x)) + 0.5;

// The upper half of a float32: 128 steps an octave, from LEAST for what half floats can be.
const FLOAT = new Float32Array(1), UPPER = new Uint16Array(FLOAT.buffer), LEAST = 103 << 7, COUNT = 40 << 7;
const upper = x => { FLOAT[0] = x; return Math.max(0, UPPER[1] - LEAST); };
const MIDDLES = Float32Array.from({length: COUNT}, (_, i) => { UPPER[0] = 0x8000, UPPER[1] = LEAST + i; return FLOAT[0]; });
UPPER[0] = 0;

// Reinhard's output of a channel, by luminance in STEPS a stop over DEPTH and its share of it, as square roots in RATIOS.
const STEPS = 64, DARKEST = -14, DEPTH = 26, RATIOS = 1024, ROOTS = (RATIOS - 1) * Math.sqrt(0.0722);
const PLACES = Int32Array.from(MIDDLES, x => Math.round(STEPS * Math.log2(x)));
// sRGB of what ACES's last matrix gives, from -LOW to 2.6 - LOW.
const LOW = 0.7, CODES = 65535 / 2.6;

// Of so many stops from middle grey, the false color in bytes.
function bandColor(stops) {
  const between = (a, b, t) => a.map((x, i) => x + (b[i] - x) * Math.min(1, t));
  return stops === 0 ? [128, 128, 128] : stops < 0 ? between([64, 158, 184], [41, 10, 82], -stops / 8)
    : stops < 4 ? between([115, 179, 89], [242, 217, 64], stops / 3) : between([242, 140, 38], [217, 20, 31], (stops - 4) / 4);
}
const packed = ([r, g, b]) => 0xff000000 | b << 16 | g << 8 | r;
const BANDS = Uint32Array.from({length: 81}, (_, i) => packed(bandColor(i - 40)));

class LookTables {
  // settings: of a LightCanvas; frames: of it.
  set({tone, overlay, stops, grey, white}, {curve, clipped}) {
    const gain = 2 ** stops, shown = gain * grey;
    this.look = overlay === "stops" ? "stops" : tone;
    this.clipped = overlay === "clipped" ? clipped : null;
    if (this.look === "stops") {
      this.bands = Uint32Array.from(MIDDLES, x => BANDS[40 + Math.round(Math.max(-40, Math.min(40, Math.log2(shown * x / 0.18))))]);
    } else if (tone === "aces") {
      this.codes ??= Uint8Array.from({length: 65536}, (_, i) => byte(srgb(i / CODES - LOW)));
      this.fitted = Float32Array.from(MIDDLES, x => CODES * fitted(1.8 * shown * x));
    } else if (tone === "reinhard") {
      this.shift = Math.round(STEPS * (Math.log2(shown) - DARKEST));
      if (this.white !== white) this.reinhard = reinhardTable(this.white = white);
    } else {
      const look = {none: x => srgb(shown * x), filmic: x => srgb(hable(2 * shown * x) / hable(white)), response: x => respond(curve, gain * x)}[tone];
      this.plain ??= new Uint8Array(65536);  // Black for what is negative
      for (let h = 0; h < 0x7c00; h += h < 0x400 ? 1 : 8) this.plain.fill(byte(look(HALVES[h < 0x400 ? h : h + 4])), h, h + 8);
      this.plain[0x7c00] = this.plain[0x7bff];
    }
  }

  // RGBA in bytes of columns from first to last, so many of them wide alike; returns whether it had to prepare the frame.
  fill(frame, pixels, first, last, wide) {
    const [prepare, row] = {aces: [acesPlanes, acesRow], reinhard: [reinhardPlanes, reinhardRow], stops: [lightPlane, bandRow]}[this.look] || [null, plainRow];
    const missing = prepare && !(this.look in frame);
    if (missing) frame[this.look] = prepare(frame);
    for (let y = 0, start = 0; y < frame.height; y++, start += frame.width) {
      row(this, frame, pixels, start + first, start + last, wide);
      if (this.clipped) clippedRow(this.clipped, pixels, start + first, start + last, wide);
      for (let beside = 1; beside < wide; beside++)
        for (let i = start + first; i + beside < start + last; i += wide) pixels[i + beside] = pixels[i];
    }
    return missing;
  }
}

function respond({half}, x) {
  const place = (Math.log2(Math.max(x, 1e-9)) - CURVE_LOW) / (CURVE_HIGH - CURVE_LOW) * (CURVE_SIZE - 1);
  const at = Math.min(CURVE_SIZE - 1, Math.max(0, place)), low = Math.min(CURVE_SIZE - 2, Math.floor(at));
  return HALVES[half[low]] + (at - low) * (HALVES[half[low + 1]] - HALVES[half[low]]);
}

function plainRow({plain}, {half, channels}, pixels, i, end, wide) {
  const step = wide * channels;
  for (let k = i * channels; i < end; i += wide, k += step)
    pixels[i] = 0xff000000 | plain[half[k + 2]] << 16 | plain[half[k + 1]] << 8 | plain[half[k]];
}

// Grey, and red where photos were clipped.
function clippedRow({half}, pixels, i, end, wide) {
  for (; i < end; i += wide) {
    const p = pixels[i], share = HALVES[half[i]], rest = 1 - share, red = 255 * share;
    const grey = rest * 0.6 * (0.2126 * (p & 255) + 0.7152 * (p >> 8 & 255) + 0.0722 * (p >> 16 & 255)) + 0.5;
    pixels[i] = 0xff000000 | grey + 0.15 * red << 16 | grey + 0.25 * red << 8 | grey + red;
  }
}

// One a pixel: the place of its luminance in MIDDLES.
function lightPlane({width, height, half, channels}) {
  const plane = new Uint16Array(width * height);
  for (let i = 0, k = 0; i < plane.length; i++, k += channels)
    plane[i] = upper(0.2126 * HALVES[half[k]] + 0.7152 * HALVES[half[k + 1]] + 0.0722 * HALVES[half[k + 2]]);
  return plane;
}
function bandRow({bands}, {stops}, pixels, i, end, wide) {
  for (; i < end; i += wide) pixels[i] = bands[stops[i]];
}

// Three a pixel: what ACES's first matrix gives.
function acesPlanes({width, height, half, channels}) {
  const planes = new Uint16Array(3 * width * height);
  for (let i = 0, k = 0; i < planes.length; i += 3, k += channels) {
    const r = HALVES[half[k]], g = HALVES[half[k + 1]], b = HALVES[half[k + 2]];
    planes[i] = upper(0.59719 * r + 0.35458 * g + 0.04823 * b);
    planes[i + 1] = upper(0.07600 * r + 0.90834 * g + 0.01566 * b);
    planes[i + 2] = upper(0.02840 * r + 0.13383 * g + 0.83777 * b);
  }
  return planes;
}
function acesRow({fitted, codes}, {aces}, pixels, i, end, wide) {
  const low = LOW * CODES, step = 3 * wide;
  for (let k = 3 * i; i < end; i += wide, k += step) {
    const x = fitted[aces[k]], y = fitted[aces[k + 1]], z = fitted[aces[k + 2]];
    pixels[i] = 0xff000000 | codes[low - 0.00327 * x - 0.07276 * y + 1.07602 * z | 0] << 16
      | codes[low - 0.10208 * x + 1.10813 * y - 0.00605 * z | 0] << 8 | codes[low + 1.60475 * x - 0.53108 * y - 0.07367 * z | 0];
  }
}

// places: of the luminance. shares: of the channels in it, ten bits each.
function reinhardPlanes({width, height, half, channels}) {
  const places = new Int16Array(width * height), shares = new Uint32Array(width * height);
  for (let i = 0, k = 0; i < places.length; i++, k += channels) {
    const r = Math.max(0, HALVES[half[k]]), g = Math.max(0, HALVES[half[k + 1]]), b = Math.max(0, HALVES[half[k + 2]]);
    const l = 0.2126 * r + 0.7152 * g + 0.0722 * b, root = l > 0 ? ROOTS / Math.sqrt(l) : 0;
    places[i] = PLACES[upper(l)];
    shares[i] = Math.sqrt(b) * root + 0.5 << 20 | Math.sqrt(g) * root + 0.5 << 10 | Math.sqrt(r) * root + 0.5;
  }
  return {places, shares};
}
function reinhardTable(white) {
  const table = new Uint8Array(DEPTH * STEPS * RATIOS), roots = Uint8Array.from({length: 4097}, (_, i) => byte(srgb((i / 4096) ** 2)));
  const whites = 1 / (white * white), curve = x => x * (1 + x * whites) / (1 + x);
  for (let place = 0, i = 0; place < DEPTH * STEPS; place++) {
    const l = 2 ** (place / STEPS + DARKEST), shown = curve(l), weight = Math.min(shown, 1), alone = shown * (1 - weight);
    for (let ratio = 0; ratio < RATIOS; ratio++) {
      const share = (ratio / ROOTS) ** 2;
      table[i++] = roots[Math.min(4096, 4096 * Math.sqrt(share * alone + curve(l * share) * weight) + 0.5 | 0)];
    }
  }
  return table;
}
function reinhardRow({reinhard, shift}, frame, pixels, i, end, wide) {
  const {places, shares} = frame.reinhard, most = DEPTH * STEPS - 1;
  for (; i < end; i += wide) {
    const place = places[i] + shift, row = (place < 0 ? 0 : place > most ? most : place) << 10, share = shares[i];
    pixels[i] = 0xff000000 | reinhard[row | share >>> 20] << 16 | reinhard[row | share >>> 10 & 1023] << 8 | reinhard[row | share & 1023];
  }
}
