// Measuring: two points give a distance; three points of the ground level the horizon. A point lies at the
// mean depth of the picture. Lengths are in units of the COLMAP model, or in metres if one length is known.

function makeMeasure(viewer, overlay) {
  const { header, camera } = viewer, measure = { tool: null, points: [], distances: [], metresPerUnit: header.metresPerUnit ?? null };
  const buttons = { distance: element('measure-distance'), ground: element('measure-ground') };
  const HINTS = {
    distance: ['Click the first point', 'Click the second point'],
    ground: ['Click three points of the ground', 'Click the second point of the ground', 'Click the third point of the ground'],
  };
  measure.units = (a, b) => norm(subtract(a, b)) / header.frame.scale;
  measure.text = units => {
    if (!measure.metresPerUnit) return `${units.toPrecision(3)} units`;
    const metres = units * measure.metresPerUnit;
    return metres < 1 ? `${(100 * metres).toPrecision(3)} cm` : `${metres.toPrecision(3)} m`;
  };
  measure.choose = tool => {
    measure.tool = measure.tool === tool ? null : tool;
    measure.points = [];
    for (const name in buttons) buttons[name].setAttribute('aria-pressed', measure.tool === name);
    viewer.renderer.gl.canvas.classList.toggle('picking', measure.tool !== null);
    measure.hint();
    viewer.invalidate();
  };
  measure.hint = () => { element('measure-hint').textContent = measure.tool ? HINTS[measure.tool][measure.points.length] : ''; };
  measure.list = () => {
    element('distances').replaceChildren(...measure.distances.map(([a, b], i) => make('li', { class: 'row' },
      make('span', {}, `${i + 1}. ${measure.text(measure.units(a, b))}`),
      make('button', { type: 'button', class: 'small', 'aria-label': `Delete distance ${i + 1}`, onclick: () => { measure.distances.splice(i, 1); measure.list(); } }, '✕'))));
    element('known').hidden = measure.distances.length === 0;
    element('scale').textContent = measure.metresPerUnit ? `1 unit is ${measure.metresPerUnit.toPrecision(4)} m.` : 'Lengths are in units of the COLMAP model. Give one true length to have metres.';
    viewer.invalidate();
  };
  // Takes a picked point of the scene. After three points of the ground, their normal on the eye's side
  // becomes up.
  measure.take = point => {
    measure.points.push(point);
    if (measure.tool === 'distance' && measure.points.length === 2) {
      measure.distances.push(measure.points);
      say(`Distance ${measure.text(measure.units(...measure.points))}`);
      measure.points = [];
    } else if (measure.tool === 'ground' && measure.points.length === 3) {
      const [a, b, c] = measure.points, normal = unit(cross(subtract(b, a), subtract(c, a)), camera.up);
      camera.up = dot(normal, subtract(camera.eye, a)) < 0 ? scaled(normal, -1) : normal;
      measure.choose('ground');
      viewer.fly(camera.levelled());
      say('The ground is level now');
    }
    measure.hint();
    measure.list();
  };
  measure.click = (x, y) => {
    if (!measure.tool) return false;
    viewer.pointAt(x, y).then(point => { if (point) measure.take(point); else say('There is no surface here'); }, error => say(error.message));
    return true;
  };
  for (const name in buttons) buttons[name].onclick = () => measure.choose(name);
  element('measure-clear').onclick = () => { measure.points = []; measure.distances = []; measure.hint(); measure.list(); };
  element('known').onsubmit = event => {
    event.preventDefault();
    const metres = Number(element('known-length').value), last = measure.distances[measure.distances.length - 1];
    if (!(metres > 0) || !last) return;
    measure.metresPerUnit = metres / measure.units(...last);
    measure.list();
    say(`Metres now: ${element('scale').textContent}`);
  };
  overlay.add(canvas => {
    // Marks the place where Enter takes a point.
    if (measure.tool) canvas.cross('#ffd166');
    measure.points.forEach(point => canvas.dot(point, '#ffd166'));
    measure.distances.forEach(([a, b]) => {
      canvas.line([a, b], '#ffd166', 2.5);
      canvas.dot(a, '#ffd166');
      canvas.dot(b, '#ffd166');
      canvas.label(scaled(add(a, b), 0.5), measure.text(measure.units(a, b)));
    });
  });
  measure.list();
  return measure;
}
