// splatwizard-decoder: .swz files in browsers and Node. See index.d.ts for the types.
import { cutEnds, DecodeError, decodedGaussians, gaussians, info, live as liveOf, moduleOf, needsTables } from './module.js';

export { DecodeError, info };

const loading = {};

const loaded = name => loading[name] ??= load(new URL(name, import.meta.url));
const compiled = name => loading[`compiled ${name}`] ??= loaded(name).then(WebAssembly.compile);
const ownTables = async bytes => (needsTables(bytes) ? loaded('./exact_tables.zlib') : null);

async function load(place) {
  if (place.protocol === 'file:' && globalThis.process?.versions?.node) {
    const { readFile } = await import('node:fs/promises');
    return readFile(place);
  }
  const response = await fetch(place);
  if (!response.ok) throw new Error(`${place}: ${response.status} ${response.statusText}`);
  return new Uint8Array(await response.arrayBuffer());
}

// All bytes of a source; `seen` is told what has come of a Response so far.
async function bytesOf(source, seen) {
  if (source instanceof Uint8Array) return source;
  if (source instanceof ArrayBuffer) return new Uint8Array(source);
  if (source.ok === false) throw new Error(`${source.url}: ${source.status} ${source.statusText}`);
  if (!seen || !source.body) return new Uint8Array(await source.arrayBuffer());  // a Response, a Blob, a File
  let bytes = new Uint8Array(1 << 16), length = 0;
  const reader = source.body.getReader();
  for (;;) {
    const { done, value } = await reader.read();
    if (done) return bytes.subarray(0, length);
    if (length + value.length > bytes.length) {
      const larger = new Uint8Array(2 * (length + value.length));
      larger.set(bytes.subarray(0, length));
      bytes = larger;
    }
    bytes.set(value, length);
    length += value.length;
    seen(bytes.subarray(0, length));
  }
}

// A worker, and what it answers to a message.
function startWorker(signal) {
  const worker = new Worker(new URL('./worker.js', import.meta.url), { type: 'module' });
  const ask = message => new Promise((resolve, reject) => {
    signal?.addEventListener('abort', () => reject(signal.reason), { once: true });
    worker.onerror = event => reject(new Error(event.message || 'the worker of the decoder could not be started'));
    worker.onmessage = ({ data: { found, reason, failure } }) => {
      if (found) resolve(found);
      else reject(reason === null ? new Error(failure) : new DecodeError(reason));
    };
    worker.postMessage(message);
  });
  return { ask, end: () => worker.terminate() };
}

const hasWorkers = typeof Worker !== 'undefined';

export async function live(source, { signal, hash = false, worker = hasWorkers } = {}) {
  signal?.throwIfAborted();
  const bytes = await bytesOf(source), module = await compiled(`./${moduleOf(bytes)}`), options = { hash, tables: await ownTables(bytes) };
  const meta = info(bytes);
  if (!worker) {
    const held = liveOf(module, bytes, options);
    return { meta, hash: held.hash, from: async eye => gaussians(bytes, { arrays: held.seen(eye), hash: held.hash }), close() {} };
  }
  const { ask, end } = startWorker(signal);
  let last = ask({ module, bytes, options, stays: true });  // one after another
  try {
    const found = await last;
    return { meta, hash: found.hash, from: eye => (last = last.then(() => ask({ eye }), () => ask({ eye }))), close: end };
  } catch (error) {
    end();
    throw error;
  }
}

export async function decode(source, { signal, onCut, hash = false, packets = 0, eye = [0, 0, 0], worker = hasWorkers } = {}) {
  signal?.throwIfAborted();
  const decoded = async (bytes, own) => {
    signal?.throwIfAborted();
    const module = await compiled(`./${moduleOf(bytes)}`), options = { ...own, eye, tables: await ownTables(bytes) };
    if (!worker) return decodedGaussians(module, bytes, options);
    const { ask, end } = startWorker(signal);
    return ask({ module, bytes, options }).finally(end);
  };
  let shown = 0, coarse = null;
  const seen = bytes => {  // a file that ends at a cut is a whole, coarser one
    const ends = cutEnds(bytes), there = ends.filter(end => end <= bytes.length).length;
    if (coarse || there <= shown || there === ends.length) return;
    shown = there;
    coarse = decoded(bytes.slice(0, ends[there - 1]), {}).then(onCut).finally(() => { coarse = null; });
  };
  const bytes = await bytesOf(source, onCut && seen);
  if (onCut && !shown) seen(bytes.subarray(0, cutEnds(bytes)[0] ?? 0));
  await coarse;
  return decoded(bytes, { hash, packets });
}
