// Camera paths: keys with a time, a pose, a field of view and a look. Between two keys the eye follows a
// cubic through all keys (Hermite, with the slope (p_{i+1} - p_{i-1}) / (t_{i+1} - t_{i-1}) at key i). The
// rotation turns at constant speed; field of view, strength and water change linearly; the mode is that of
// the key before. `use3d render --path` reads the same file and draws the same frames.

const PATH_FORMAT = '3d-use camera path';

function betweenKeys(keys, time) {
  const t = clamp(time, keys[0].time, keys[keys.length - 1].time);
  let i = 0;
  while (i < keys.length - 2 && t >= keys[i + 1].time) i++;
  if (keys.length === 1) return { ...keys[0] };
  const a = keys[i], b = keys[i + 1], span = b.time - a.time, u = span > 0 ? (t - a.time) / span : 1;
  const slope = k => {
    const before = keys[Math.max(0, k - 1)], after = keys[Math.min(keys.length - 1, k + 1)], apart = after.time - before.time;
    return apart > 0 ? scaled(subtract(after.eye, before.eye), 1 / apart) : [0, 0, 0];
  };
  const [va, vb] = [slope(i), slope(i + 1)], u2 = u * u, u3 = u2 * u;
  const eye = [0, 1, 2].map(k => (2 * u3 - 3 * u2 + 1) * a.eye[k] + (u3 - 2 * u2 + u) * span * va[k] + (3 * u2 - 2 * u3) * b.eye[k] + (u3 - u2) * span * vb[k]);
  const number = name => mix(a[name], b[name], u);
  return {
    eye, rotation: slerp(a.rotation, b.rotation, u), fov: number('fov'), focus: number('focus'),
    mode: (u >= 1 ? b : a).mode, strength: number('strength'), water: number('water'), time: t,
  };
}

function pathFile(keys, frame, framesPerSecond) {
  return {
    format: PATH_FORMAT, version: 1, frame: 'colmap', interpolation: 'hermite', frames_per_second: framesPerSecond,
    keys: keys.map(key => ({ time: key.time, ...shotForFile(key, frame) })),
  };
}

// Paths for other programs: every frame of the path is a camera of its own, in the COLMAP frame. nerfstudio
// has camera-to-world matrices with y up and z back. COLMAP has quaternions in images.txt, lenses in
// cameras.txt, and no points.
function framesOf(keys, framesPerSecond) {
  const start = keys[0].time, count = Math.round((keys[keys.length - 1].time - start) * framesPerSecond) + 1;
  return Array.from({ length: count }, (_, i) => betweenKeys(keys, start + i / framesPerSecond));
}

function nerfstudioPath(keys, frame, framesPerSecond, width, height) {
  const frames = framesOf(keys, framesPerSecond);
  return {
    camera_type: 'perspective', render_width: width, render_height: height, fps: framesPerSecond, seconds: frames.length / framesPerSecond, is_cycle: false, smoothness_value: 0,
    camera_path: frames.map(key => {
      const { center, rotation: [x, y, z] } = toColmap(frame, key);
      return { camera_to_world: [0, 1, 2].flatMap(k => [x[k], -y[k], -z[k], center[k]]).concat(0, 0, 0, 1), fov: key.fov, aspect: width / height };
    }),
    keyframes: [],
  };
}

function colmapPath(keys, frame, framesPerSecond, width, height) {
  const f = key => height / 2 / Math.tan(key.fov * DEGREE / 2);
  const frames = framesOf(keys, framesPerSecond), line = numbers => numbers.join(' ');
  const images = frames.map((key, i) => {
    const { center, rotation } = toColmap(frame, key), moved = rotation.map(row => -dot(row, center));
    return `${line([i + 1, ...quaternionOf(rotation), ...moved, i + 1])} frame_${String(i).padStart(5, '0')}.png\n\n`;
  });
  return { 'images.txt': images.join(''), 'cameras.txt': frames.map((key, i) => `${line([i + 1, 'PINHOLE', width, height, f(key), f(key), width / 2, height / 2])}\n`).join('') };
}

function keysOfFile(file, frame) {
  if (file?.camera_path) throw new Error("this is nerfstudio's path, a camera per frame: draw it with use3d render SCENE --path FILE --out FOLDER");
  checkFile(file, PATH_FORMAT, 'camera path', 'keys');
  if (!file.keys.length) throw new Error('the camera path has no keys');
  const keys = file.keys.map((key, i) => {
    if (!Number.isFinite(key.time)) throw new Error(`key ${i + 1}: expected a time`);
    return { ...shotOfFile(key, frame, `key ${i + 1}`), time: key.time };
  });
  if (keys.some((key, i) => i && key.time < keys[i - 1].time)) throw new Error('the times of the keys do not rise');
  return keys;
}

function makePath(viewer, overlay) {
  const { camera, header } = viewer, available = modesOf(header), path = { keys: [], playing: null, framesPerSecond: 30 };
  const list = element('keys');
  path.length = () => (path.keys.length ? path.keys[path.keys.length - 1].time - path.keys[0].time : 0);
  path.changed = () => {
    list.replaceChildren(...path.keys.map((key, i) => make('li', { class: 'row' },
      make('button', { type: 'button', class: 'link', onclick: () => path.show(key.time, true) }, `${i + 1}`, make('span', { class: 'soft' }, ` ${MODES[key.mode].title}`)),
      make('label', { class: 'seconds' }, make('input', { type: 'number', min: 0, step: 0.5, value: +key.time.toFixed(2), 'aria-label': `Time of key ${i + 1} in seconds`, onchange: event => path.retime(i, Number(event.target.value)) }), ' s'),
      make('button', { type: 'button', class: 'small', 'aria-label': `Delete key ${i + 1}`, onclick: () => { path.keys.splice(i, 1); path.changed(); } }, '✕'))));
    element('no-keys').hidden = path.keys.length > 0;
    for (const id of ['play', 'record', 'save-path']) element(id).disabled = path.keys.length < 2;
    element('scrub').disabled = path.keys.length < 2;
    element('scrub').max = path.length();
    element('path-length').textContent = path.keys.length > 1 ? `${path.length().toFixed(1)} s` : '';
    viewer.invalidate();
  };
  path.retime = (i, time) => {
    if (Number.isFinite(time) && time >= 0) path.keys[i].time = time;
    path.keys.sort((a, b) => a.time - b.time);
    path.changed();
  };
  path.add = () => {
    const last = path.keys[path.keys.length - 1], seconds = Number(element('key-seconds').value), time = last ? last.time + (seconds > 0 ? seconds : 3) : 0;
    path.keys.push({ ...camera.state(), ...viewer.look, time });
    path.changed();
    say(`Key ${path.keys.length} added`);
  };
  path.show = (time, fly = false) => {
    if (!path.keys.length) return;
    const key = betweenKeys(path.keys, time), mode = available.includes(key.mode) ? key.mode : 'reconstruction';
    viewer.setLook({ mode, strength: key.strength, water: key.water });
    if (fly) viewer.fly(key); else { camera.set(key); viewer.moved(); }
    element('scrub').value = time - path.keys[0].time;
  };
  path.stop = () => { if (path.playing) { path.playing.done?.(); path.playing = null; element('play').textContent = 'Play'; } };
  path.play = done => {
    viewer.flight.stop();
    path.playing = { started: null, done };
    element('play').textContent = 'Stop';
    viewer.invalidate();
  };
  viewer.steps.push(now => {
    if (!path.playing) return;
    path.playing.started ??= now;
    const time = (now - path.playing.started) / 1000;
    path.show(path.keys[0].time + time);
    if (time >= path.length()) path.stop();
  });
  element('add-key').onclick = path.add;
  element('play').onclick = () => (path.playing ? path.stop() : path.play());
  element('scrub').oninput = event => { path.stop(); path.show(path.keys[0].time + Number(event.target.value)); };
  path.json = () => JSON.stringify(pathFile(path.keys, header.frame, path.framesPerSecond), null, 1);
  // Pictures for other programs have the shape of this one and the height of Full HD.
  path.foreign = format => {
    const { clientWidth, clientHeight } = viewer.renderer.gl.canvas, height = 1080, width = 2 * Math.round(540 * clientWidth / Math.max(1, clientHeight));
    if (format === 'colmap') return colmapPath(path.keys, header.frame, path.framesPerSecond, width, height);
    return { 'camera_path.json': JSON.stringify(nerfstudioPath(path.keys, header.frame, path.framesPerSecond, width, height)) };
  };
  element('save-path').onclick = () => {
    const format = element('path-format').value, files = format === '3d-use' ? { 'camera-path.json': path.json() } : path.foreign(format);
    for (const name in files) download(name, name.endsWith('.json') ? 'application/json' : 'text/plain', files[name]);
  };
  path.read = text => { path.keys = keysOfFile(JSON.parse(text), header.frame); path.changed(); };
  opensFiles('open-path', text => { path.read(text); return `${path.keys.length} keys`; });
  overlay.add(canvas => {
    if (path.keys.length < 2 || path.playing || !element('panel-path').classList.contains('open')) return;
    const steps = 12 * path.keys.length, start = path.keys[0].time;
    canvas.line(Array.from({ length: steps + 1 }, (_, i) => betweenKeys(path.keys, start + path.length() * i / steps).eye), '#ffd166', 2);
    path.keys.forEach(key => canvas.dot(key.eye, '#ffd166', 4));
  });
  path.changed();
  return path;
}
