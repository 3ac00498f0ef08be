// The renderer of a browser without a graphics card: a worker draws on the processor, and the canvas shows its
// last picture. While the camera moves, pictures are as large as they can be drawn in MOVING milliseconds.

const MOVING = 90, DIVISORS = [1, 1.5, 2, 3, 4, 6];

function makeSoftwareRenderer(canvas, scene, shown) {
  const context = canvas.getContext('2d'), worker = makeWorker(), { header } = scene, { medium, enhancement } = header;
  const waiting = new Map(), cube = medium.side ? new Uint16Array(scene.cube.slice().buffer) : null;
  let id = 0, busy = null, wanted = null, rung = 3;

  // One half of a picture in the worker's words: its look as numbers, and the water in front of this camera.
  function half(camera, look, from, to) {
    const mode = MODES[look.mode], amount = mode.water && medium.kind !== 'none' ? look.water : 0;
    const affine = mode.graded && enhancement.affine.map(v => look.strength * v);
    return {
      camera, from, to,
      look: { objects: mode.objects, veil: mode.veil, depth: !!mode.depth, strength: look.strength, affine, gains: gainsOf(look) },
      water: amount > 0 && {
        amount, bands: (medium.degree + 1) ** 2, side: medium.side, cube, harmonic: medium.side ? null : aggregated(medium, camera.eye),
        grade: mode.graded && enhancement.water && { ...guideTable(enhancement, camera.eye, look.strength), affine, guide: enhancement.guide, kept: enhancement.keptWater.map(k => 1 - look.strength * (1 - k)) },
      },
    };
  }
  function send({ camera, look, left, at, moving }) {
    const divisor = moving ? DIVISORS[rung] : 1, width = Math.max(1, Math.round(camera.width / divisor)), height = Math.max(1, Math.round(camera.height / divisor));
    const [sx, sy] = [width / camera.width, height / camera.height], [fx, fy, cx, cy] = camera.lens, small = { ...camera, lens: [fx * sx, fy * sy, cx * sx, cy * sy], width, height };
    const cut = left ? Math.round(at * width) : 0;
    busy = { id: ++id, moving, camera };
    worker.postMessage({ id, halves: [[left, 0, cut], [look, cut, width]].filter(([, from, to]) => to > from).map(([one, from, to]) => half(small, one, from, to)) });
  }
  worker.onmessage = ({ data }) => {
    if (data.picture) { waiting.get(data.id)(data.picture); waiting.delete(data.id); return; }
    if (data.id !== busy?.id) return;
    const { moving, camera } = busy;
    busy = null;
    if (data.bytes) {
      [canvas.width, canvas.height] = [data.width, data.height];
      context.putImageData(new ImageData(data.bytes, data.width, data.height), 0, 0);
      if (moving && data.milliseconds > MOVING) rung = Math.min(rung + 1, DIVISORS.length - 1);
      else if (moving && data.milliseconds < MOVING / 3) rung = Math.max(rung - 1, 0);
    }
    if (wanted) { const next = wanted; wanted = null; send(next); }
    if (data.bytes) shown(camera);
  };
  const renderer = {
    gl: { canvas, isContextLost: () => false },
    load(data) { worker.postMessage({ scene: { count: data.count, degree: data.degree, geometry: data.geometry, harmonics: data.harmonics, evidence: data.evidence } }); },
    settled: () => !busy && !wanted,
    // A picture for the screen. A newer one replaces one that waits, and one of a camera that stood still.
    ask(camera, look, left, at, moving) {
      const asked = { camera: { ...camera, eye: [...camera.eye], rotation: camera.rotation.map(row => [...row]) }, look: { ...look }, left, at, moving };
      if (busy?.moving) wanted = asked; else { wanted = null; send(asked); }
    },
    picture(camera, look) {
      return new Promise(done => { waiting.set(++id, done); worker.postMessage({ id, floats: true, halves: [half(camera, look, 0, camera.width)] }); });
    },
  };
  renderer.load(scene);
  return renderer;
}
