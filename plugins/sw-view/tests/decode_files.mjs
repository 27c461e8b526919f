// Decodes the files that are named: a line of JSON each, [hash, null] or [null, reason].
import { readFile } from 'node:fs/promises';
import { decode } from '../src/sw_view/splatwizard-decoder/index.js';

for (const path of process.argv.slice(2)) {
  const told = await decode(await readFile(path), { hash: true }).then(found => [found.hash, null], error => [null, error.message]);
  console.log(JSON.stringify(told));
}
