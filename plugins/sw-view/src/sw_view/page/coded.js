// In a worker, behind splatwizard-decoder/module.js: from an encoded file to what the GPU reads, as data.js does from the
// page's own bytes. Ranges and steps come from the page, so that both look alike; means keep all their bits.
const SH_C0 = 0.28209479177387814, FAINTEST = 1 / 255, BRIGHTEST = 8, FLAT = -18.420680743952367;  // ln 1e-8

function drawable(arrays, facts) {
  const { means, opacity_logits } = arrays, [x, y, z, reach] = facts.reach, middle = [x, y, z], rows = [];
  const widths = Object.values(arrays).map(({ shape, data }) => [data, data.length / (shape[0] || 1)]);
  for (let i = 0; i < means.shape[0]; i++) {
    let keep = 1 / (1 + Math.exp(-opacity_logits.data[i])) >= FAINTEST;
    for (let k = 0; k < 3; k++) keep &&= Math.abs(means.data[3 * i + k] - middle[k]) <= reach;
    for (const [data, width] of widths) for (let k = i * width; keep && k < (i + 1) * width; k++) keep = Number.isFinite(data[k]);
    if (keep) rows.push(i);
  }
  return rows;
}

function rotationWord(quats, i) {  // index of the largest part, then the others, ten bits each
  const q = quats.subarray(4 * i, 4 * i + 4), norm = Math.hypot(...q), unit = norm > 0 ? [...q].map(v => v / norm) : [1, 0, 0, 0];
  let largest = 0;
  for (let k = 1; k < 4; k++) if (Math.abs(unit[k]) > Math.abs(unit[largest])) largest = k;
  const sign = unit[largest] < 0 ? -511 : 511;
  const cells = unit.filter((_, k) => k !== largest).map(v => Math.min(1022, Math.max(0, Math.round(v * Math.SQRT2 * sign) + 511)));
  return largest << 30 | cells[0] << 20 | cells[1] << 10 | cells[2];
}

function forGpu(arrays, facts) {
  const { log_scales, quats, opacity_logits, sh_dc, sh_rest } = arrays, rows = drawable(arrays, facts), n = rows.length;
  const axes = log_scales.shape[1], stride = 3 * sh_rest.shape[1], coefficients = 3 * ((facts.degree + 1) ** 2 - 1);
  const texels = Math.ceil(coefficients / 16), harmonics = new Uint8Array(16 * texels * n);
  const means = new Float32Array(3 * n), words = new Uint32Array(8 * n), floats = new Float32Array(words.buffer);
  const [low, step] = facts.scales, [dark, tint] = facts.colors;
  const within = (x, least, most) => Math.min(most, Math.max(least, x));
  const steps = Array.from({ length: coefficients }, (_, k) => facts.bands[Math.floor(Math.sqrt(1 + Math.floor(k / 3))) - 1]);
  rows.forEach((i, to) => {
    for (let k = 0; k < 3; k++) {
      floats[8 * to + k] = means[3 * to + k] = arrays.means.data[3 * i + k];
      const size = k < axes ? log_scales.data[axes * i + k] : FLAT;
      words[8 * to + 3] |= within(Math.round((size - low) / step), 0, 1023) << 10 * k;
      const color = within(0.5 + SH_C0 * sh_dc.data[3 * i + k], -BRIGHTEST, BRIGHTEST), most = k < 2 ? 2047 : 1023;
      words[8 * to + 5] |= within(Math.round((color - dark) / (2047 * tint) * most), 0, most) << 11 * k;
    }
    words[8 * to + 4] = rotationWord(quats.data, i);
    words[8 * to + 6] = Math.round(255 / (1 + Math.exp(-opacity_logits.data[i])));
    for (let k = 0; k < coefficients; k++) {
      harmonics[16 * texels * to + k] = within(Math.round(within(sh_rest.data[stride * i + k], -BRIGHTEST, BRIGHTEST) / steps[k]) + 128, 0, 255);
    }
  });
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
    const decoded = packets => plain(parameters(module, file, { tables, packets }).arrays);
    if (coarse && cutEnds(file).length > 1) tell(decoded(1), facts, eye, false);
    tell(decoded(0), facts, eye, true);
  } catch (error) {
    self.postMessage({ failure: error.message });
  }
};
