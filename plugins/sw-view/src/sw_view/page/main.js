// The page: unpacks the scene, draws when something moved, and offers cameras. `#camera=N&size=WxH&still` draws camera N
// alone at that size, once and exactly, and says so in the title: for tests and for pictures.
const find = id => document.getElementById(id);
const facts = JSON.parse(find('facts').textContent);
const asked = new URLSearchParams(location.hash.slice(1));
const still = asked.has('still');

const firstCamera = () => Math.min(facts.cameras.length - 1, Math.max(0, Number(asked.get('camera')) || 0));

function fail(error) {
  find('told').textContent = error.message || String(error);
  find('told').hidden = false;
  document.documentElement.dataset.state = 'failed';
}

const REST = 150;  // milliseconds after which an eye rests

// Returns what takes further Gaussians: the whole, where this is the first cut; what is seen from another place.
function begin(gaussians, { whole, look, eye: seenFrom }) {
  const canvas = find('canvas');
  const sources = { vertex: find('vertex').textContent.trim(), fragment: find('fragment').textContent.trim() };
  const renderer = new Renderer(canvas, gaussians, facts, sources, still);
  const worker = new Worker(URL.createObjectURL(new Blob([find('worker').textContent], { type: 'text/javascript' })));
  worker.postMessage({ means: gaussians.means }, [gaussians.means.buffer]);

  let sorting = 0, number = 0, wanted = false, drawing = 0, share = 1, last = 0, rest = 0, ordered = false;
  let hearing = true;  // also until the eye is there
  let next = null;  // Gaussians whose order is not there yet
  let looking = null, resting = 0;  // the place that Gaussians are asked for; a timer
  const photo = find('photo'), border = find('border'), toggle = find('photograph');
  let standing = '';  // the pose of the camera that was chosen last
  const eye = new Eye(facts, () => { wanted = true; again(); watch(); compare(); if (!hearing) parent.postMessage(eye.place, '*'); });
  const isElsewhere = () => Boolean(look) && eye.eye.some((x, k) => x !== seenFrom[k]);
  hearing = parent === window;
  document.documentElement.classList.toggle('paired', !hearing);
  if (!hearing) addEventListener('message', ({ data, source }) => {  // beside another model: both look from one place
    if (source !== parent) return;
    if (data.over !== undefined) document.documentElement.dataset.half = data.over;
    if (!data.axes) return;
    hearing = true;
    eye.take(data);
    hearing = false;
  });

  function compare() {  // the photograph is shown where the eye is that of its camera
    const isSeen = toggle.ariaPressed === 'true' && !toggle.hidden && JSON.stringify(eye.pose) === standing;
    photo.hidden = border.hidden = !isSeen;
    photo.style.clipPath = `inset(0 0 0 ${border.value}%)`;
  }

  function watch() {  // asks for what is seen once the eye rests; one place at a time
    clearTimeout(resting);
    if (look) resting = setTimeout(() => { if (!looking && isElsewhere()) look(looking = [...eye.eye]); }, REST);
  }

  function sort() {  // one order at a time; the newest place is asked for when it is there
    if (sorting || !wanted) return;
    const { R, tau } = eye.pose;
    sorting = ++number, wanted = false;
    worker.postMessage({ forward: R.slice(6), offset: tau[2], nearest: facts.near, number });
  }

  function again() { drawing ||= requestAnimationFrame(draw); }

  function draw(now) {
    drawing = 0;
    const moving = wanted || sorting;
    sort();
    const fixed = asked.get('size')?.match(/^(\d+)x(\d+)$/);
    const ratio = fixed || still ? 1 : Math.min(2, devicePixelRatio) * share;
    const [width, height] = fixed ? [+fixed[1], +fixed[2]] : [canvas.clientWidth, canvas.clientHeight];
    if (fixed) canvas.style.cssText = `width:${width}px;height:${height}px`;
    const pixels = [width, height].map(length => Math.max(1, Math.round(length * ratio)));
    if (ordered) {  // also where nothing is in front of the eye
      renderer.draw(eye.pose, eye.lens(...pixels), ...pixels);
      said();
    }
    clearTimeout(rest);
    if (moving && !still) {  // a frame that takes over 50 ms is drawn smaller until the eye rests
      if (now - last > 50 && now - last < 1000) share = Math.max(0.3, share * 0.85);
      rest = setTimeout(() => { if (share < 1) { share = 1; again(); } }, 250);
    }
    last = now;
  }

  function said() {
    const data = document.documentElement.dataset;
    data.firstFrame ||= performance.now().toFixed(1);
    data.frames = Number(data.frames || 0) + 1;
    data.state = !whole || next || isElsewhere() ? 'coarse' : sorting || wanted ? 'sorting' : 'drawn';
    if (whole && !next) data.firstWhole ||= performance.now().toFixed(1);
    if (still && data.state === 'drawn') document.title = `still ${find('camera').value}`;
  }

  worker.onmessage = ({ data }) => {
    if (data.number === sorting) sorting = 0;
    if (next && data.number > next.after) {
      renderer.put(next.gaussians);
      next = null;
    }
    renderer.take(data.sorted);
    ordered = true;
    again();
  };
  worker.onerror = fail;

  const list = find('camera');
  facts.cameras.forEach((camera, i) => list.add(new Option(camera.name, i)));
  const show = i => {
    list.value = (i + facts.cameras.length) % facts.cameras.length;
    eye.pivot = facts.pivot;
    const camera = facts.cameras[list.value];
    toggle.hidden = !camera.photo;
    photo.src = camera.photo ?? 'data:,';
    eye.show(camera);
    standing = JSON.stringify(eye.pose);
    compare();
  };
  border.addEventListener('input', compare);
  list.addEventListener('change', () => show(Number(list.value)));
  const fly = find('fly');
  const commands = {
    '[': () => show(Number(list.value) - 1), ']': () => show(Number(list.value) + 1), r: () => show(Number(list.value)),
    f: () => { eye.orbits = !eye.orbits; fly.setAttribute('aria-pressed', String(!eye.orbits)); },
    p: () => { toggle.ariaPressed = String(toggle.ariaPressed !== 'true'); if (!toggle.hidden) show(Number(list.value)); },
    h: () => { find('help').hidden = !find('help').hidden; }, '?': () => commands.h(),
  };
  for (const [id, key] of [['before', '['], ['after', ']'], ['reset', 'r'], ['fly', 'f'], ['photograph', 'p'], ['more', 'h']]) {
    find(id).addEventListener('click', () => { commands[key](); });
  }
  listen(canvas, eye, commands);
  canvas.addEventListener('webglcontextlost', () => fail(new Error('The GPU was taken away: load the page again.')));
  new ResizeObserver(again).observe(canvas);
  if (still) document.body.classList.add('still');
  show(firstCamera());
  return (finer, { eye: place }) => {
    worker.postMessage({ means: finer.means }, [finer.means.buffer]);
    next = { gaussians: finer, after: number };
    whole = wanted = true;
    looking = null, seenFrom = place;
    if (!drawing) sort();  // and draws when the order is there
    watch();
  };
}

let refine = null;
const first = new Eye(facts, () => {}), parts = Object.fromEntries(['gaussians', 'decoder', 'wasm', 'tables'].map(id => [id, find(id)]));
first.show(facts.cameras[firstCamera()]);
eachGaussians(parts, facts, !still, first.eye, (found, of) => {
  if (refine) refine(found, of); else refine = begin(found, of);
  if (of.whole) for (const id of ['gaussians', 'decoder', 'wasm', 'tables']) find(id)?.remove();
}).catch(fail);
