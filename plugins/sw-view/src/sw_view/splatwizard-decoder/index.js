// splatwizard-decoder: .swz files in browsers and Node. See index.d.ts for the types.
import { DecodeError, gaussians, info, parameters } from './module.js';

export { DecodeError, info };

let loading = null;

async function load() {
  const place = new URL('./decoder.wasm', import.meta.url);
  if (place.protocol === 'file:' && globalThis.process?.versions?.node) {
    const { readFile } = await import('node:fs/promises');
    return WebAssembly.compile(await readFile(place));
  }
  const response = await fetch(place);
  if (!response.ok) throw new Error(`${place}: ${response.status} ${response.statusText}`);
  return WebAssembly.compile(await response.arrayBuffer());
}

async function bytesOf(source) {
  if (source instanceof Uint8Array) return source;
  if (source instanceof ArrayBuffer) return new Uint8Array(source);
  if (source.ok === false) throw new Error(`${source.url}: ${source.status} ${source.statusText}`);
  return new Uint8Array(await source.arrayBuffer());  // a Response, a Blob, a File
}

function inWorker(module, bytes, hash, signal) {
  const worker = new Worker(new URL('./worker.js', import.meta.url), { type: 'module' });
  return new Promise((resolve, reject) => {
    signal?.addEventListener('abort', () => reject(signal.reason), { once: true });
    worker.onerror = event => reject(new Error(event.message || 'the worker of the decoder could not be started'));
    worker.onmessage = ({ data: { found, reason, failure } }) => {
      if (found) resolve(found);
      else reject(reason === null ? new Error(failure) : new DecodeError(reason));
    };
    worker.postMessage({ module, bytes, hash });
  }).finally(() => worker.terminate());
}

export async function decode(source, { signal, hash = false, worker = typeof Worker !== 'undefined' } = {}) {
  signal?.throwIfAborted();
  const [module, bytes] = await Promise.all([loading ??= load(), bytesOf(source)]);
  signal?.throwIfAborted();
  if (worker) return inWorker(module, bytes, hash, signal);
  return gaussians(bytes, parameters(module, bytes, { hash }));
}
