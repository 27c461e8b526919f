// Of each file that is named a line of JSON: for each step of `refined` whether it is the whole, and whether its arrays are
// those that `parameters` gives of as many packets.
import { readFile } from 'node:fs/promises';
import { moduleOf, parameters, refined } from '../src/sw_view/splatwizard-decoder/module.js';

const folder = new URL('../src/sw_view/splatwizard-decoder/', import.meta.url);
const tables = new Uint8Array(await readFile(new URL('exact_tables.zlib', folder)));
const bytesIn = arrays => Object.entries(arrays).map(([name, { data }]) => [name, Buffer.from(data.slice().buffer)]);
const same = (a, b) => a.length === b.length && a.every(([name, bytes], i) => name === b[i][0] && bytes.equals(b[i][1]));

for (const path of process.argv.slice(2)) {
  const bytes = new Uint8Array(await readFile(path)), steps = [];
  const module = await WebAssembly.compile(await readFile(new URL(moduleOf(bytes), folder)));
  for (const { arrays, whole } of refined(module, bytes, { tables })) {
    const wanted = parameters(module, bytes, { tables, packets: whole ? 0 : 1 });
    steps.push([whole, same(bytesIn(arrays), bytesIn(wanted.arrays))]);
  }
  console.log(JSON.stringify(steps));
}
