// Decodes one file in a thread of its own; of one whose Gaussians depend on the eye, tells what is seen from each place that it is then sent.
import { decodedGaussians, gaussians, live } from './module.js';

let held = null;

self.onmessage = ({ data: { module, bytes, options, stays, eye } }) => {
  try {
    if (stays) {
      held = { bytes, ...live(module, bytes, options) };
      self.postMessage({ found: { hash: held.hash } });
      return;
    }
    const found = eye ? gaussians(held.bytes, { arrays: held.seen(eye), hash: held.hash }) : decodedGaussians(module, bytes, options);
    const { means, quats, scales, opacities, sh } = found;
    self.postMessage({ found }, [means, quats, scales, opacities, sh].map(array => array.buffer));
  } catch (error) {
    self.postMessage({ reason: error.name === 'DecodeError' ? error.message : null, failure: String(error) });
  }
};
