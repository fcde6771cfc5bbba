// Tone maps as tables, for a processor instead of WebGL. What costs much is done once for a frame or a white point, so
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

class LookTables {
  // settings: of a LightCanvas; curve: of the response.
  set({tone, stops, grey, white}, curve) {
    const gain = 2 ** stops, shown = gain * grey;
    this.tone = tone;
    if (tone === "aces") {
      this.codes ??= Uint8Array.from({length: 65536}, (_, i) => byte(srgb(i / CODES - LOW)));
      this.fitted = Float32Array.from(MIDDLES, x => CODES * fitted(1.8 * shown * x));
    } else if (tone === "reinhard") {
      this.shift = Math.round(STEPS * (Math.log2(shown) - DARKEST));
      if (this.white !== white) this.reinhard = reinhardTable(this.white = white);
    } else {
      const look = {none: x => srgb(shown * x), filmic: x => srgb(hable(2 * shown * x) / hable(white)), response: x => respond(curve, gain * x)}[tone];
      this.plain ??= new Uint8Array(65536);  // Black for what is negative
      for (let h = 0; h < 0x7c00; h++) this.plain[h] = byte(look(HALVES[h]));
      this.plain[0x7c00] = this.plain[0x7bff];
    }
  }

  // RGBA in bytes of columns from first to last, so many of them wide alike; returns whether it had to prepare the frame.
  fill(frame, pixels, first, last, wide) {
    const prepare = {aces: acesPlanes, reinhard: reinhardPlanes}[this.tone], missing = prepare && !(this.tone in frame);
    if (missing) frame[this.tone] = prepare(frame);
    const row = {aces: acesRow, reinhard: reinhardRow}[this.tone] || plainRow;
    for (let y = 0, start = 0; y < frame.height; y++, start += frame.width) {
      row(this, frame, pixels, start + first, start + last, wide);
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
