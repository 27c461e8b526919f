// The worker: orders Gaussians by their depth, the farthest first, and of equal ones the last first, as the rasterizers do:
// those of an anchor may share a place. It gets their means once, then directions.
let means = null;

function order(forward, offset, nearest) {
  const n = means.length / 3;
  let keys = new Uint32Array(n), rows = new Uint32Array(n);
  const depth = new Float32Array(1), bits = new Uint32Array(depth.buffer);
  const low = new Uint32Array(65537), high = new Uint32Array(65537);
  let count = 0;
  for (let i = n - 1; i >= 0; i--) {
    depth[0] = forward[0] * means[3 * i] + forward[1] * means[3 * i + 1] + forward[2] * means[3 * i + 2] + offset;
    if (!(depth[0] > nearest)) continue;
    const key = ~bits[0] >>> 0;  // bits of positive floats are in the order of their values
    keys[count] = key, rows[count] = i;
    low[(key & 65535) + 1]++, high[(key >>> 16) + 1]++;
    count++;
  }
  const halfKeys = new Uint32Array(count), halfRows = new Uint32Array(count), sorted = new Uint32Array(count);
  for (let i = 0; i < 65536; i++) low[i + 1] += low[i], high[i + 1] += high[i];
  for (let i = 0; i < count; i++) {
    const at = low[keys[i] & 65535]++;
    halfKeys[at] = keys[i], halfRows[at] = rows[i];
  }
  for (let i = 0; i < count; i++) sorted[high[halfKeys[i] >>> 16]++] = halfRows[i];
  return sorted;
}

self.onmessage = ({ data }) => {
  if (data.means) {
    means = data.means;
    return;
  }
  const sorted = order(data.forward, data.offset, data.nearest);
  self.postMessage({ sorted, number: data.number }, [sorted.buffer]);
};
