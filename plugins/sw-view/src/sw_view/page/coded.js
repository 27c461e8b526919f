// In a worker, behind splatwizard-decoder/module.js: from an encoded file to what the GPU reads, as data.js does from the
// page's own bytes. Ranges and steps come from the page, so that both look alike; means keep all their bits.
const SH_C0 = 0.28209479177387814, FAINTEST = 1 / 255, BRIGHTEST = 8, FLAT = -18.420680743952367;  // ln 1e-8

// Rows of Gaussians that can be drawn: finite, not too faint, not too far.
function drawable(arrays, { reach: [x, y, z, reach] }) {
  const logits = arrays.opacity_logits.data, means = arrays.means.data, n = logits.length, odd = new Uint8Array(n);
  for (const { data } of Object.values(arrays)) markOdd(data, data.length / (n || 1), odd);
  const rows = new Uint32Array(n);
  let count = 0;
  for (let i = 0; i < n; i++) {
    const isNear = Math.abs(means[3 * i] - x) <= reach && Math.abs(means[3 * i + 1] - y) <= reach && Math.abs(means[3 * i + 2] - z) <= reach;
    if (isNear && !odd[i] && 1 / (1 + Math.exp(-logits[i])) >= FAINTEST) rows[count++] = i;
  }
  return rows.subarray(0, count);
}

function markOdd(data, width, odd) {  // a product with 0 is NaN where a number is not finite
  let sum = 0;
  for (let k = 0; k < data.length; k++) sum += 0 * data[k];
  for (let k = 0; sum !== 0 && k < data.length; k++) if (0 * data[k] !== 0) odd[Math.floor(k / width)] = 1;
}

const tenBits = (part, sign) => Math.min(1022, Math.max(0, Math.round(part * Math.SQRT2 * (sign < 0 ? -511 : 511)) + 511));

function rotationWord(quats, i) {  // index of the largest part, then the others, ten bits each
  const at = 4 * i, norm = Math.hypot(quats[at], quats[at + 1], quats[at + 2], quats[at + 3]), by = norm > 0 ? norm : Infinity;
  let largest = 0;
  for (let k = 1; k < 4; k++) if (Math.abs(quats[at + k]) > Math.abs(quats[at + largest])) largest = k;
  const part = k => tenBits(quats[at + k] / by, quats[at + largest]);
  return largest << 30 | part(largest ? 0 : 1) << 20 | part(largest < 2 ? 2 : 1) << 10 | part(largest < 3 ? 3 : 2);
}

function forGpu(arrays, facts) {
  const { log_scales, quats, opacity_logits, sh_dc, sh_rest } = arrays, rows = drawable(arrays, facts), n = rows.length;
  const axes = log_scales.shape[1], stride = 3 * sh_rest.shape[1], coefficients = 3 * ((facts.degree + 1) ** 2 - 1);
  const texels = Math.ceil(coefficients / 16), harmonics = new Uint8Array(16 * texels * n);
  const means = new Float32Array(3 * n), words = new Uint32Array(8 * n), floats = new Float32Array(words.buffer);
  const [low, step] = facts.scales, [dark, tint] = facts.colors, { data: rest } = sh_rest;
  const within = (x, least, most) => (x < least ? least : x > most ? most : x);
  const steps = Float64Array.from({ length: coefficients }, (_, k) => facts.bands[Math.floor(Math.sqrt(1 + Math.floor(k / 3))) - 1]);
  for (let to = 0; to < n; to++) {
    const i = rows[to];
    for (let k = 0; k < 3; k++) {
      floats[8 * to + k] = means[3 * to + k] = arrays.means.data[3 * i + k];
      const size = k < axes ? log_scales.data[axes * i + k] : FLAT;
      words[8 * to + 3] |= within(Math.round((size - low) / step), 0, 1023) << 10 * k;
      const color = within(0.5 + SH_C0 * sh_dc.data[3 * i + k], -BRIGHTEST, BRIGHTEST), most = k < 2 ? 2047 : 1023;
      words[8 * to + 5] |= within(Math.round((color - dark) / (2047 * tint) * most), 0, most) << 11 * k;
    }
    words[8 * to + 4] = rotationWord(quats.data, i);
    words[8 * to + 6] = Math.round(255 / (1 + Math.exp(-opacity_logits.data[i])));
    for (let k = 0, from = stride * i, at = 16 * texels * to; k < coefficients; k++) {
      harmonics[at + k] = within(Math.round(within(rest[from + k], -BRIGHTEST, BRIGHTEST) / steps[k]) + 128, 0, 255);
    }
  }
  return { means, words, harmonics: new Uint32Array(harmonics.buffer), texels };
}

let held = null;  // a file whose Gaussians depend on the eye, and the facts of its page

function tell(arrays, facts, eye, whole) {
  const found = forGpu(arrays, facts);
  self.postMessage({ found, eye, whole }, [found.means.buffer, found.words.buffer, found.harmonics.buffer]);
}

self.onmessage = async ({ data: { wasm, file, tables, facts, coarse, eye } }) => {
  try {
    if (held) {  // a place that the eye came to
      tell(held.seen(eye), held.facts, eye, true);
      return;
    }
    const module = await WebAssembly.compile(wasm);
    if (facts.live) {
      held = { facts, ...live(module, file, { tables }) };
      tell(held.seen(eye), facts, eye, true);
      return;
    }
    for (const { arrays, whole } of refined(module, file, { coarse, tables })) tell(plain(arrays), facts, eye, whole);
  } catch (error) {
    self.postMessage({ failure: error.message });
  }
};
