// splatwizard-decoder: .swz files in browsers and Node. See index.d.ts for the types.
import { cutEnds, DecodeError, gaussians, info, needsTables, parameters } from './module.js';

export { DecodeError, info };

let loading = null, loadingTables = null;

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

function inWorker(module, bytes, options, signal) {
  const worker = new Worker(new URL('./worker.js', import.meta.url), { type: 'module' });
  return new Promise((resolve, reject) => {
    signal?.addEventListener('abort', () => reject(signal.reason), { once: true });
    worker.onerror = event => reject(new Error(event.message || 'the worker of the decoder could not be started'));
    worker.onmessage = ({ data: { found, reason, failure } }) => {
      if (found) resolve(found);
      else reject(reason === null ? new Error(failure) : new DecodeError(reason));
    };
    worker.postMessage({ module, bytes, options });
  }).finally(() => worker.terminate());
}

export async function decode(source, { signal, onCut, hash = false, packets = 0, worker = typeof Worker !== 'undefined' } = {}) {
  signal?.throwIfAborted();
  const module = await (loading ??= load(new URL('./decoder.wasm', import.meta.url)).then(WebAssembly.compile));
  const decoded = async (bytes, own) => {
    signal?.throwIfAborted();
    const tables = needsTables(bytes) ? await (loadingTables ??= load(new URL('./exact_tables.zlib', import.meta.url))) : null;
    const options = { ...own, tables };
    return worker ? inWorker(module, bytes, options, signal) : gaussians(bytes, parameters(module, bytes, options));
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
