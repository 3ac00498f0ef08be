// Draws the picture on the screen, and only when something changed. While the camera moves, a slow machine
// gets a lower resolution; when it stands still, the picture has full resolution. Without a graphics card, a
// worker or the program draws, and answers later.

const SCALES = [1, 0.75, 0.5, 0.35, 0.25], SLOW = 45, FAST = 18, STILL = 160;

function makeViewer(canvas, scene) {
  const { header } = scene, listeners = { frame: [], look: [] };
  let dirty = true, coarse = false, movedAt = performance.now(), rung = 0, lastFrame = 0, shownAt = 0;
  const range = [1, 10];
  const camera = makeCamera(header, () => canvas.clientWidth / Math.max(1, canvas.clientHeight)), { server } = scene;
  const software = !server && !usesWebgl() && drawsInSoftware(), later = server || software;
  const answered = pose => { viewer.shown = pose; viewer.tell('frame'); };
  const renderer = server ? makeServerRenderer(canvas, server, answered) : software ? makeSoftwareRenderer(canvas, scene, answered) : makeRenderer(canvas, scene);
  const invalidate = () => { dirty = true; };
  const sorter = later ? { ask() {}, load() {}, settled: () => true } : makeSorter(sorted => { if (!viewer.ready) performance.mark('use3d ordered'); renderer.setOrder(sorted); invalidate(); viewer.ready = true; });
  if (!later) sorter.load(scene.centres);
  const moved = () => { camera.stay(); movedAt = performance.now(); invalidate(); };
  const flight = makeFlight(camera, moved);
  const viewer = {
    drawsHere: !server, software, camera, renderer, sorter, flight, header, invalidate, moved, ready: !!later,
    shown: null,              // the camera of the picture on the screen
    held: false,              // true while a picture is drawn for a caller: no frames meanwhile
    look: { mode: openingMode(header), strength: 1, water: 1, white: header.white?.gains ?? null },
    compare: null,            // the mode on the left, or null
    at: 0.5,
    on: (name, f) => listeners[name].push(f),
    tell: name => listeners[name].forEach(f => f()),
    setLook(change) { Object.assign(viewer.look, change); invalidate(); viewer.tell('look'); },
    setCompare(mode, at = viewer.at) { viewer.compare = mode; viewer.at = clamp(at, 0, 1); invalidate(); viewer.tell('look'); },
    leftLook: () => (viewer.compare ? { ...viewer.look, mode: viewer.compare } : null),
    fly: (goal, seconds) => flight.to(goal, seconds),
    steps: [],                // functions that move the camera by themselves, called before every frame
  };

  // Depth is shown between the 2 % and 98 % quantiles of the depths in the picture. These come from a small
  // picture of their own.
  function depthRange() {
    const aspect = canvas.clientWidth / Math.max(1, canvas.clientHeight), height = 54, width = Math.max(8, Math.round(height * aspect));
    const small = renderer.picture(camera.pinhole(width, height), { mode: 'depth', strength: 0, water: 0 });
    const known = [];
    for (let i = 0; i < small.length; i += 4) if (small[i] > 0 && small[i + 3] > 0.02) known.push(small[i]);
    if (!known.length) return;
    known.sort((a, b) => a - b);
    range[0] = known[Math.floor(0.02 * (known.length - 1))];
    range[1] = Math.max(known[Math.floor(0.98 * (known.length - 1))], 1.0001 * range[0]);
  }

  function draw(now) {
    const moving = now - movedAt < STILL;
    if (later) {
      const most = Math.min(1, 1600 / Math.max(1, canvas.clientWidth));
      renderer.ask(camera.pinhole(Math.max(1, Math.round(most * canvas.clientWidth)), Math.max(1, Math.round(most * canvas.clientHeight))), viewer.look, viewer.leftLook(), viewer.at, moving);
      coarse = moving;
      if (moving) setTimeout(invalidate, STILL + 10);
      return;
    }
    // While the camera moves, a frame that came late makes the next pictures smaller, and one that came early
    // makes them larger.
    if (moving && now - shownAt < 400) {
      const took = now - shownAt;
      if (took > SLOW) rung = Math.min(rung + 1, SCALES.length - 1); else if (took < FAST && now - lastFrame > 800) { rung = Math.max(rung - 1, 0); lastFrame = now; }
    }
    const scale = (moving ? SCALES[rung] : 1) * Math.min(window.devicePixelRatio || 1, 2);
    const width = Math.max(1, Math.round(canvas.clientWidth * scale)), height = Math.max(1, Math.round(canvas.clientHeight * scale));
    if (canvas.width !== width || canvas.height !== height) { canvas.width = width; canvas.height = height; }
    if ([viewer.look.mode, viewer.compare].includes('depth') && !moving) depthRange();
    viewer.shown = camera.pinhole(width, height);
    renderer.draw(viewer.shown, viewer.look, viewer.leftLook(), viewer.at, range);
    shownAt = now;
    // Draws with full resolution again as soon as nothing moves.
    coarse = moving && scale < Math.min(window.devicePixelRatio || 1, 2);
    if (coarse) setTimeout(invalidate, STILL + 10);
    viewer.tell('frame');
  }

  function frame(now) {
    requestAnimationFrame(frame);
    if (viewer.held) return;
    flight.step(now);
    for (const step of viewer.steps) step(now);
    sorter.ask(camera.state());
    if (!dirty || !viewer.ready || renderer.gl.isContextLost()) return;
    dirty = false;
    draw(now);
  }
  // The first view fits the window also after a phone was turned.
  let home = camera.home();
  new ResizeObserver(() => {
    const there = camera.fov === home.fov && camera.eye.every((v, i) => v === home.eye[i]);
    home = camera.home();
    if (there) camera.set(home);
    invalidate();
  }).observe(canvas);
  requestAnimationFrame(frame);
  // The complete scene, in place of the Gaussians with which the page began.
  viewer.load = data => { renderer.load(data); sorter.load(data.centres); invalidate(); };
  viewer.complete = !scene.complete;
  viewer.settled = () => viewer.ready && viewer.complete && sorter.settled() && !dirty && !coarse && !flight.busy() && (!later || renderer.settled());
  // The median depth of the picture around a place in CSS pixels; null if nothing is there.
  viewer.depthAt = async (x, y) => {
    const size = 9, pinhole = camera.pinhole(canvas.clientWidth, canvas.clientHeight), [fx, fy, cx, cy] = pinhole.lens;
    const view = { ...pinhole, width: size, height: size, lens: [fx, fy, cx - x + size / 2, cy - y + size / 2] };
    if (server) return renderer.depth(view);
    const part = await renderer.picture(view, { mode: 'depth', strength: 0, water: 0 }), found = [];
    for (let i = 0; i < part.length; i += 4) if (part[i + 3] > 0.25) found.push(part[i]);
    invalidate();
    return found.length ? found.sort((a, b) => a - b)[found.length >> 1] : null;
  };
  viewer.pointAt = async (x, y) => {
    const { eye } = camera, direction = camera.through(x, y, canvas.clientWidth, canvas.clientHeight), z = await viewer.depthAt(x, y);
    return z === null ? null : along(eye, direction, z);
  };
  return viewer;
}
