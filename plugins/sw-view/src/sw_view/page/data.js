// From the text in the page to what the GPU reads. The layout is that of sw_view/packing.py.
function bytesFrom(text) {
  const binary = atob(text.trim()), bytes = new Uint8Array(binary.length);
  for (let i = 0; i < binary.length; i++) bytes[i] = binary.charCodeAt(i);
  return bytes;
}

async function unpacked(text) {
  const stream = new Blob([bytesFrom(text)]).stream().pipeThrough(new DecompressionStream('deflate'));
  return new Response(stream).arrayBuffer();
}

// Tells of what the page holds, the encoded file and its decoder (coded.js) or Gaussians as they are drawn: of the first
// cut of a file with cuts, if that is asked for, then of all. Gaussians that depend on the eye are those that are seen from `eye`, and
// `look` asks for those of another place.
async function eachGaussians({ gaussians, decoder, wasm, tables }, facts, coarse, eye, tell) {
  const text = gaussians.textContent;
  if (!decoder) return tell(gaussiansFrom(await unpacked(text), facts), { whole: true });
  const worker = new Worker(URL.createObjectURL(new Blob([decoder.textContent], { type: 'text/javascript' })));
  const look = facts.live ? place => worker.postMessage({ eye: place }) : null;
  const module = await unpacked(wasm.textContent);
  return new Promise((resolve, reject) => {
    worker.onerror = reject;
    worker.onmessage = ({ data: { found, eye: place, whole, failure } }) => {
      try {
        if (failure) throw new Error(failure);
        tell(found, { whole, look, eye: place });
      } catch (error) {
        reject(error);
      }
      if (whole && !look) resolve();
    };
    worker.postMessage({ wasm: module, file: bytesFrom(text), tables: tables && bytesFrom(tables.textContent), facts, coarse, eye });
  }).finally(() => worker.terminate());
}

function gaussiansFrom(buffer, facts) {
  const n = facts.count, chunks = Math.ceil(n / facts.chunk), coefficients = 3 * ((facts.degree + 1) ** 2 - 1);
  let at = 0;
  const take = (type, length) => {
    const found = new type(buffer, at, length);
    at += found.byteLength;
    return found;
  };
  const bounds = take(Float32Array, 6 * chunks);
  const rotations = take(Uint32Array, n), colors = take(Uint32Array, n), scales = take(Uint32Array, n);
  const places = [0, 1, 2].map(() => take(Uint16Array, n));
  const opacities = take(Uint8Array, n), coefficientBytes = take(Uint8Array, n * coefficients);
  const means = new Float32Array(3 * n), words = new Uint32Array(8 * n), floats = new Float32Array(words.buffer);
  for (let i = 0; i < n; i++) {
    const chunk = 6 * Math.floor(i / facts.chunk);
    for (let k = 0; k < 3; k++) {
      const low = bounds[chunk + k], high = bounds[chunk + 3 + k];
      floats[8 * i + k] = means[3 * i + k] = low + (high - low) * places[k][i] / 65535;
    }
    words[8 * i + 3] = scales[i];
    words[8 * i + 4] = rotations[i], words[8 * i + 5] = colors[i], words[8 * i + 6] = opacities[i];
  }
  const texels = Math.ceil(coefficients / 16), harmonics = new Uint8Array(16 * texels * n);
  for (let i = 0; i < n; i++) {
    harmonics.set(coefficientBytes.subarray(i * coefficients, (i + 1) * coefficients), 16 * texels * i);
  }
  return { means, words, harmonics: new Uint32Array(harmonics.buffer), texels };
}
