// Decodes one file in a thread of its own.
import { gaussians, parameters } from './module.js';

self.onmessage = ({ data: { module, bytes, options } }) => {
  try {
    const found = gaussians(bytes, parameters(module, bytes, options));
    const { means, quats, scales, opacities, sh } = found;
    self.postMessage({ found }, [means, quats, scales, opacities, sh].map(array => array.buffer));
  } catch (error) {
    self.postMessage({ reason: error.name === 'DecodeError' ? error.message : null, failure: String(error) });
  }
};
