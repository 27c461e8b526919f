// Decodes the files that are named: a line of JSON each, [hash, null] or [null, reason], and how many Gaussians the
// first cut has. After `--into FOLDER` the arrays of each go there too: means, quats, scales, opacities, sh.
import { readFile, writeFile } from 'node:fs/promises';
import { basename, join } from 'node:path';
import { decode } from '../src/sw_view/splatwizard-decoder/index.js';

const paths = process.argv.slice(2), folder = paths[0] === '--into' ? paths.splice(0, 2)[1] : null;
for (const path of paths) {
  try {
    let coarse = [];
    const onCut = ({ count }) => coarse.push(count);
    const { hash, means, quats, scales, opacities, sh } = await decode(await readFile(path), { hash: true, onCut });
    if (folder) await writeFile(join(folder, basename(path)), Buffer.concat([means, quats, scales, opacities, sh].map(a => new Uint8Array(a.buffer))));
    console.log(JSON.stringify([hash, null, ...coarse]));
  } catch (error) {
    console.log(JSON.stringify([null, error.message]));
  }
}
