// The WebAssembly module and what drives it: a file in, named arrays out. It knows neither files nor networks nor workers.

/** What is wrong with a file, in the words of the Python reader: `section 'sh1': its CRC-32 does not match: ...`. */
export class DecodeError extends Error {
  constructor(reason) {
    super(reason);
    this.name = 'DecodeError';
    /** Name of the section that is to blame, or null: the file or its header. */
    this.section = /^section '([^']*)'/.exec(reason)?.[1] ?? null;
  }
}

const MAX_HEADER = 1 << 19;

/** The header of a file: method, method_version, requires, raster, static, sections. Checks only what it needs. */
export function info(bytes) {
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  if (bytes.length < 10 || view.getUint32(0, false) !== 0x5350575a) throw new DecodeError('not a .swz file');
  const length = view.getUint32(6, true);
  if (length > MAX_HEADER || 14 + length > bytes.length) throw new DecodeError('the file ends inside its header: it is truncated');
  try {
    return JSON.parse(new TextDecoder('utf-8', { fatal: true }).decode(bytes.subarray(10, 10 + length)));
  } catch (error) {
    throw new DecodeError(`header is not acceptable JSON: ${error.message}`);
  }
}

/** Lengths at which a file may end, up to the end of each of its packets; [] without cuts, or before its header is there. */
export function cutEnds(bytes) {
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  if (bytes.length < 10 || bytes.length < 14 + view.getUint32(6, true)) return [];
  return (info(bytes).cuts ?? []).map(([, end]) => 14 + view.getUint32(6, true) + end);
}

const OF_ANCHORS = ['hac', 'hac-plus', 'cat-3dgs'], WITH_TABLES = ['wisp', ...OF_ANCHORS], LIVE = ['compact3dgs', ...OF_ANCHORS];
const OF_CODEBOOKS = ['chimerags', 'compact3dgs'], CODECS_OF_CODEBOOKS = ['vectree', 'gaussians-indexed', 'raht', 'gsc-quant'];

// Of what is no file {}: the decoder then says why.
function headerOf(bytes) {
  try {
    return info(bytes);
  } catch {
    return {};
  }
}

/** Whether the Gaussians of a file depend on where they are seen from: anchors spawn them, or a field has their colours. */
export function isLive(bytes) { return LIVE.includes(headerOf(bytes).method); }

/** Name of the WebAssembly module that knows a file. */
export function moduleOf(bytes) {
  const { method, static: values } = headerOf(bytes);
  if (OF_ANCHORS.includes(method)) return 'anchors.wasm';
  return OF_CODEBOOKS.includes(method) || CODECS_OF_CODEBOOKS.includes(values?.codec) ? 'codebooks.wasm' : 'decoder.wasm';
}

/** Whether a file is decoded by the exact tables, exact_tables.zlib. */
export function needsTables(bytes) { return WITH_TABLES.includes(headerOf(bytes).method); }

// An instance of a module that has decoded a file, and what reads its memory.
function decodedBy(module, bytes, packets, tables) {
  const { exports } = new WebAssembly.Instance(module, {});
  exports._initialize();
  const text = at => {
    const memory = new Uint8Array(exports.memory.buffer, at);
    return new TextDecoder().decode(memory.subarray(0, memory.indexOf(0)));
  };
  const put = (content, at) => new Uint8Array(exports.memory.buffer, at, content.length).set(content);
  const guarded = call => {
    try {
      return call();
    } catch (error) {
      if (!(error instanceof WebAssembly.RuntimeError)) throw error;
      throw new DecodeError(text(exports.swz_refusal()) || `the decoder failed: ${error.message}`);
    }
  };
  guarded(() => {
    put(bytes, exports.swz_input(bytes.length));
    if (tables) put(tables, exports.swz_tables(tables.length));
    exports.swz_decode(packets);
  });
  return { exports, text, guarded };
}

// Arrays of what an instance has decoded, by name, each { shape, data }: views of its memory.
function arraysIn({ exports, text }) {
  const FIELDS = 8, arrays = {};  // pointers to name and values, whether it is an index, number of axes, four lengths
  const fields = new Uint32Array(exports.memory.buffer, exports.swz_arrays(), FIELDS * exports.swz_count());
  for (let i = 0; i < fields.length; i += FIELDS) {
    const shape = [...fields.subarray(i + 4, i + 4 + fields[i + 3])], size = shape.reduce((a, b) => a * b, 1);
    const Values = fields[i + 2] ? Uint32Array : Float32Array;
    arrays[text(fields[i])] = { shape, data: new Values(exports.memory.buffer, fields[i + 1], size) };
  }
  return arrays;
}

/**
 * The parameters in a file by name, each { shape, data: Float32Array }; with `hash` the SHA-256 of them, which
 * `sw decode --hash` prints; of a file with cuts `packets` may be how many to read. `tables` are the bytes of
 * exact_tables.zlib, for files that need them. An instance of the module lives for this call only, and with it all memory
 * but the result.
 */
export function parameters(module, bytes, { hash = false, packets = 0, tables = null } = {}) {
  const instance = decodedBy(module, bytes, packets, tables), arrays = arraysIn(instance);
  for (const array of Object.values(arrays)) array.data = array.data.slice();
  return { arrays, hash: hash ? instance.text(instance.exports.swz_hash()) : null };
}

/**
 * What `parameters` has of the first cut of a file with cuts, unless `coarse` is false, and then of all of it: each
 * { arrays, whole }, which lie in the memory of an instance until the next are asked for.
 */
export function* refined(module, bytes, { coarse = true, tables = null } = {}) {
  let first = null;
  if (coarse && cutEnds(bytes).length > 1) {
    first = decodedBy(module, bytes, 1, tables);
    yield { arrays: arraysIn(first), whole: false };
  }
  const goesOn = first?.guarded(() => first.exports.swz_go_on(0));  // else the method of the file begins anew
  yield { arrays: arraysIn(goesOn ? first : decodedBy(module, bytes, 0, tables)), whole: true };
}

/**
 * A file whose Gaussians depend on the eye: `seen(eye)` gives the raw parameters of those that are seen from a place
 * [x, y, z], as `parameters` has those of others. An instance of the module lives as long as this.
 */
export function live(module, bytes, { hash = false, tables = null } = {}) {
  const { exports, text, guarded } = decodedBy(module, bytes, 0, tables);
  const seen = eye => {
    const count = guarded(() => exports.swz_see(...eye));
    const pointers = new Uint32Array(exports.memory.buffer, exports.swz_seen(), 5);
    const [means, opacities, scales, quats, colors] = [3, 1, 3, 4, 3].map((width, i) => (
      new Float32Array(exports.memory.buffer, pointers[i], width * count).slice()));
    return {
      means: { shape: [count, 3], data: means }, quats: { shape: [count, 4], data: quats },
      log_scales: { shape: [count, 3], data: scales.map(scale => Math.log(Math.max(SMALLEST_SCALE, scale))) },
      opacity_logits: { shape: [count], data: opacities.map(logit) },
      sh_dc: { shape: [count, 1, 3], data: colors.map(color => (color - 0.5) / SH_BAND_0) },
      sh_rest: { shape: [count, 0, 3], data: new Float32Array(0) },
    };
  };
  return { seen, hash: hash ? text(exports.swz_hash()) : null };
}

const SH_BAND_0 = 0.28209479177387814;
const LOGIT_MARGIN = 1e-6, SMALLEST_SCALE = 1e-9;  // as the Python package makes plain Gaussians of shared ones

function logit(opacity) {
  const x = Math.min(1 - LOGIT_MARGIN, Math.max(LOGIT_MARGIN, opacity));
  return Math.log(x / (1 - x));
}

// A row of `of` for each Gaussian, by its index.
function gathered({ shape: [, ...rest], data }, { data: index }) {
  const width = rest.reduce((a, b) => a * b, 1), found = new Float32Array(width * index.length);
  index.forEach((row, i) => found.set(data.subarray(width * row, width * (row + 1)), width * i));
  return { shape: [index.length, ...rest], data: found };
}

/** Raw parameters of plain Gaussians, of whatever `parameters` gave: codebooks are gathered. */
export function plain(arrays) {
  if (arrays.sh_dc) return arrays;
  const { means, color_dc, color_rest, color_index, log_factors, opacity_values, shape_scales, shape_quats, shape_index } = arrays;
  const log_scales = gathered(shape_scales, shape_index);
  log_scales.data.forEach((scale, k) => {
    log_scales.data[k] = Math.log(Math.max(SMALLEST_SCALE, Math.exp(log_factors.data[Math.floor(k / 3)]) * scale));
  });
  return {
    means, log_scales, quats: gathered(shape_quats, shape_index),
    opacity_logits: { shape: opacity_values.shape, data: opacity_values.data.map(logit) },
    sh_dc: gathered(color_dc, color_index), sh_rest: gathered(color_rest, color_index),
  };
}

const SURFEL_THICKNESS = 1e-8;  // world units, as `sw export` gives surfels a third axis

/** Gaussians of a file as a renderer wants them; where they depend on the eye those that are seen from `eye`. */
export function decodedGaussians(module, bytes, options) {
  if (!isLive(bytes)) return gaussians(bytes, parameters(module, bytes, options));
  const { seen, hash } = live(module, bytes, options);
  return gaussians(bytes, { arrays: seen(options.eye), hash });
}

/** Gaussians as a renderer wants them, of what `parameters` or `seen` gave. */
export function gaussians(bytes, { arrays, hash }) {
  const { means, log_scales, quats, opacity_logits, sh_dc, sh_rest } = plain(arrays);
  const count = means.shape[0], rest = 3 * sh_rest.shape[1], axes = log_scales.shape[1];
  const scales = new Float32Array(3 * count).fill(SURFEL_THICKNESS), sh = new Float32Array((3 + rest) * count);
  for (let i = 0; i < count; i++) {
    for (let k = 0; k < axes; k++) scales[3 * i + k] = Math.exp(log_scales.data[axes * i + k]);
    sh.set(sh_dc.data.subarray(3 * i, 3 * i + 3), (3 + rest) * i);
    sh.set(sh_rest.data.subarray(rest * i, rest * (i + 1)), (3 + rest) * i + 3);
  }
  const opacities = opacity_logits.data.map(x => 1 / (1 + Math.exp(-x)));
  const degree = Math.sqrt(1 + rest / 3) - 1;
  return { count, degree, means: means.data, quats: quats.data, scales, opacities, sh, meta: info(bytes), hash };
}
