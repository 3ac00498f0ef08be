// White balance by hand: a click on something grey or white. Its colour is the median of a small patch of the
// scene, in each look that has gains. The patch is drawn from the nearest photograph that sees the place. The
// gains make it grey: g = (G/R, 1, G/B); for several places they are the geometric mean. `use3d … --white
// NAME:X,Y` does the same, and the page shows the line to paste. The balance is right only at the distance of
// the place.

const PATCH = 15, PATCH_LONGEST = 1024, PATCH_SOLID = 0.5, PATCH_DARK = 0.02, GAIN_RANGE = [0.2, 5], NEAR_VIEWS = 6;
const WHITE_LOOKS = ['clear', 'enhanced', 'enhanced-clear'];

function makeWhite(viewer, server, picture) {
  const { header, camera } = viewer, white = { picking: false, clicks: [], gains: header.white?.gains ?? null };
  // The amount of water that the page opens with; `enhanced` is measured with it.
  const water = viewer.look.water, kept = header.white;

  // The camera scaled so that its longer side has at most PATCH_LONGEST pixels, and the box of the patch in
  // its picture.
  function patchOf(view, x, y) {
    const factor = Math.min(1, PATCH_LONGEST / Math.max(view.width, view.height)), side = n => Math.max(1, Math.round(n * factor));
    const [width, height] = factor < 1 ? [side(view.width), side(view.height)] : [view.width, view.height];
    const [sx, sy] = [width / view.width, height / view.height], [fx, fy, cx, cy] = view.lens, half = PATCH >> 1;
    const from = (at, scale) => Math.max(0, Math.floor((at + 0.5) * scale) - half), to = (at, scale, most) => Math.min(most, Math.floor((at + 0.5) * scale) + half + 1);
    const [left, top] = [from(x, sx), from(y, sy)];
    return { small: { eye: view.eye, rotation: view.rotation, lens: [fx * sx, fy * sy, cx * sx, cy * sy], width, height }, box: [left, top, to(x, sx, width) - left, to(y, sy, height) - top] };
  }

  // { colors, depth } at a pixel of a camera, or { problem }.
  white.measure = async (view, x, y) => {
    if (!viewer.drawsHere) return server.json('/patch', { page: server.page, camera: { eye: view.eye, rotation: view.rotation, lens: view.lens, width: view.width, height: view.height }, x, y, water });
    const { small, box } = patchOf(view, x, y);
    const middle = (part, channel) => part.filter((_, i) => i % 4 === channel).sort((a, b) => a - b)[part.length >> 3];
    const depth = await picture(small, { mode: 'depth', strength: 1, water }, box);
    if (!(middle(depth, 3) >= PATCH_SOLID)) return { problem: 'there is no surface, only water; choose a place on something solid' };
    const colors = [];
    for (const mode of WHITE_LOOKS) {
      const shown = header.enhancement ? mode : mode === 'enhanced' ? 'reconstruction' : 'clear';
      const part = await picture(small, { mode: shown, strength: 1, water, white: null }, box);
      colors.push([0, 1, 2].map(channel => middle(part, channel)));
    }
    return { colors, depth: middle(depth, 0) };
  };

  // The gains that remove the mean cast of places in one look, or the problem that prevents them.
  function cast(clicks, look) {
    const sum = [0, 0];
    for (const { colors } of clicks) {
      const [r, g, b] = colors[look];
      if (!(Math.min(r, g, b) > PATCH_DARK)) return { problem: 'the place is too dark to tell its colour; choose a brighter one' };
      const u = [Math.log(r / g), Math.log(b / g)];
      if (u.some(v => Math.exp(-v) < GAIN_RANGE[0] || Math.exp(-v) > GAIN_RANGE[1])) return { problem: 'the place is far from grey; choose something grey or white' };
      u.forEach((v, k) => { sum[k] += v / clicks.length; });
    }
    return { gains: [Math.exp(-sum[0]), 1, Math.exp(-sum[1])] };
  }
  function gainsOfClicks(clicks) {
    const [clear, behind, enhanced] = [0, 1, 2].map(look => cast(clicks, look));
    const problem = clear.problem ?? (header.enhancement ? enhanced.problem : undefined);
    if (problem) return { problem };
    return { gains: header.enhancement ? { clear: clear.gains, enhanced: behind.gains ?? NO_GAINS, 'enhanced-clear': enhanced.gains } : { clear: clear.gains, enhanced: NO_GAINS, 'enhanced-clear': clear.gains } };
  }

  // Photographs that may see a point, the nearest eye first, with its pixel and its depth there.
  function seenBy(point) {
    const seen = [];
    for (const view of header.cameras) {
      const from = subtract(point, view.eye), [px, py, z] = view.rotation.map(row => dot(row, from)), [fx, fy, cx, cy] = view.lens;
      const [x, y] = [fx * px / z + cx, fy * py / z + cy];
      if (z > 0 && x >= 0 && y >= 0 && x < view.width && y < view.height) seen.push({ view, x: Math.floor(x), y: Math.floor(y), z, far: norm(subtract(view.eye, camera.eye)) });
    }
    return seen.sort((a, b) => a.far - b.far).slice(0, NEAR_VIEWS);
  }

  // Takes the place under a point of the picture, in CSS pixels.
  white.take = async (x, y) => {
    const point = await viewer.pointAt(x, y);
    if (!point) { say('There is no surface here'); return; }
    let click = null;
    for (const { view, x: px, y: py, z } of seenBy(point)) {
      const found = await white.measure(view, px, py);
      // In this photograph something else stands in front of the place.
      if (found.problem || Math.abs(found.depth - z) > 0.1 * z) continue;
      click = { ...found, view: view.name, x: px, y: py, width: view.width, height: view.height };
      break;
    }
    if (!click) {
      const canvas = viewer.renderer.gl.canvas, here = camera.pinhole(canvas.clientWidth, canvas.clientHeight);
      const found = await white.measure(here, Math.floor(x), Math.floor(y));
      if (found.problem) { say(found.problem); return; }
      click = { ...found, view: null };
    }
    const { gains, problem } = gainsOfClicks([...white.clicks, click]);
    if (problem) { say(problem); return; }
    white.clicks.push(click);
    white.choose(false);
    white.set(gains);
    say('The colours follow this place');
  };

  const [pick, off, text, line] = [element('white-pick'), element('white-off'), element('white-text'), element('white-line')];
  white.set = gains => { white.gains = gains; viewer.setLook({ white: gains }); };
  white.choose = (on = !white.picking) => {
    white.picking = on;
    pick.setAttribute('aria-pressed', on);
    viewer.renderer.gl.canvas.classList.toggle('picking', on);
    if (on) say('Click on something grey or white');
  };
  white.click = (x, y) => {
    if (!white.picking) return false;
    white.take(x, y).catch(error => say(error.message));
    return true;
  };
  white.line = () => (white.clicks.length && white.clicks.every(click => click.view !== null)
    ? white.clicks.map(({ view, x, y, width, height }) => `--white ${/^[\w.\-/]+$/.test(view) ? '' : "'"}${view}:${x},${y}@${width}x${height}${/^[\w.\-/]+$/.test(view) ? '' : "'"}`).join(' ') : null);
  white.json = () => JSON.stringify({
    ...(white.clicks.length || !kept ? { format: '3d-use white', version: 1, method: 'patch' } : kept),
    clicks: !white.clicks.length && kept ? kept.clicks ?? [] : white.clicks.filter(click => click.view !== null).map(({ view, x, y, depth }) => ({ view, x, y, distance: depth / header.frame.scale })),
    gains: white.gains,
  }, null, 1);

  // Another part of the page may have set the look, for example a key of a path.
  viewer.on('look', () => {
    white.gains = viewer.look.white;
    off.disabled = element('white-save').disabled = !white.gains;
    if (!white.gains) white.clicks = [];
    const command = white.line();
    element('white-command').hidden = !command;
    line.textContent = command ?? '';
    const distances = white.clicks.map(click => (click.depth / header.frame.scale).toPrecision(2)).join(', ');
    text.textContent = !white.gains ? 'Click on something that is grey or white; the colours of the scene follow at once.'
      : white.clicks.length ? `Measured ${distances} units away. It is correct at that distance; nearer or farther surfaces may keep a tint.${command ? ' For every command:' : ' Save the file, and give it to a command by --white FILE.'}`
        : `Balanced by ${kept?.method === 'patch' ? 'places that were clicked on' : kept?.method === 'reef' ? 'the mean colour of reefs' : 'its surfaces, taken for grey'}.`;
  });
  pick.onclick = () => white.choose();
  off.onclick = () => { white.clicks = []; white.choose(false); white.set(null); say('Colours unchanged'); };
  element('white-save').onclick = () => download(`${header.name}.white.json`, 'application/json', white.json());
  element('white-copy').onclick = () => navigator.clipboard?.writeText(line.textContent).then(() => say('Copied'), () => say('The browser does not let a page copy; select the line'));
  return white;
}
