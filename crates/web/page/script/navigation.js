// Moving the camera, as in other viewers: a left drag orbits, or looks around when flying. A right drag looks
// around; a middle drag, or Shift and drag, pans. The wheel zooms to the pointer, and a double click moves
// the camera to that place. One finger orbits; two pan, zoom and roll. WASD with Q and E fly.

function makeNavigation(canvas, viewer) {
  const { camera } = viewer, pointers = new Map(), pressed = new Set();
  const navigation = { flying: false, speed: 1, click: null, changed: [] };
  const size = () => Math.max(1, canvas.clientHeight);
  const perPixel = () => 2 * Math.tan(camera.fov * DEGREE / 2) * camera.focus / size();
  navigation.setFlying = flying => { navigation.flying = flying; navigation.changed.forEach(f => f()); };

  const place = event => { const box = canvas.getBoundingClientRect(); return [event.clientX - box.left, event.clientY - box.top]; };
  const pan = (dx, dy) => camera.move(-dx * perPixel(), dy * perPixel(), 0);
  const zoomAt = (factor, x, y) => camera.zoom(factor, camera.through(x, y, canvas.clientWidth, canvas.clientHeight));

  let travelled = 0;
  canvas.addEventListener('pointerdown', event => {
    canvas.focus({ preventScroll: true });
    if (pointers.size === 0) travelled = 0;
    pointers.set(event.pointerId, place(event));
    try { canvas.setPointerCapture(event.pointerId); } catch { /* a pointer that is gone already */ }
    viewer.flight.stop();
    navigation.interrupted?.();
  });
  canvas.addEventListener('pointermove', event => {
    const last = pointers.get(event.pointerId);
    if (!last) return;
    const now = place(event), [dx, dy] = [now[0] - last[0], now[1] - last[1]];
    travelled += Math.abs(dx) + Math.abs(dy);
    if (pointers.size >= 2) { pinch(event.pointerId, last, now); pointers.set(event.pointerId, now); viewer.moved(); return; }
    pointers.set(event.pointerId, now);
    const turn = 0.9 * Math.PI / size();
    if (event.buttons & 4 || (event.buttons & 1 && event.shiftKey)) pan(dx, dy);
    else if (event.buttons & 2 || (navigation.flying && event.buttons & 1)) camera.look(-dx * turn * 0.6, dy * turn * 0.6 * -1);
    else camera.orbit(-dx * turn, -dy * turn);
    viewer.moved();
  });
  function pinch(id, last, now) {
    const [other] = [...pointers].filter(([key]) => key !== id).map(([, p]) => p);
    const before = [last[0] - other[0], last[1] - other[1]], after = [now[0] - other[0], now[1] - other[1]];
    const ratio = Math.hypot(...before) / Math.max(1, Math.hypot(...after));
    pan((now[0] - last[0]) / 2, (now[1] - last[1]) / 2);
    zoomAt(clamp(ratio, 0.8, 1.25), (now[0] + other[0]) / 2, (now[1] + other[1]) / 2);
    camera.roll(-(Math.atan2(after[1], after[0]) - Math.atan2(before[1], before[0])));
  }
  const released = event => {
    const was = pointers.get(event.pointerId);
    pointers.delete(event.pointerId);
    if (was && event.type === 'pointerup' && event.button === 0 && travelled < 6 && pointers.size === 0) navigation.click?.(was[0], was[1]);
  };
  canvas.addEventListener('pointerup', released);
  canvas.addEventListener('pointercancel', released);
  canvas.addEventListener('contextmenu', event => event.preventDefault());
  canvas.addEventListener('wheel', event => {
    event.preventDefault();
    const lines = event.deltaMode === 1 ? 18 : event.deltaMode === 2 ? 300 : 1;
    zoomAt(Math.exp(clamp(event.deltaY * lines, -240, 240) * 0.0014), ...place(event));
    viewer.flight.stop();
    viewer.moved();
  }, { passive: false });
  navigation.goTo = async (x, y) => {
    const point = await viewer.pointAt(x, y);
    if (!point) return false;
    const rotation = looking(subtract(point, camera.eye), camera.up), away = norm(subtract(point, camera.eye));
    const focus = Math.max(0.55 * away, 0.02 * camera.reach);
    viewer.fly({ eye: along(point, rotation[2], -focus), rotation, fov: camera.fov, focus });
    return true;
  };
  canvas.addEventListener('dblclick', event => { if (!navigation.picking?.()) navigation.goTo(...place(event)); });

  // Keys that are held down: flying, and turning with the arrow keys.
  const HELD = ['KeyW', 'KeyA', 'KeyS', 'KeyD', 'KeyQ', 'KeyE', 'ArrowLeft', 'ArrowRight', 'ArrowUp', 'ArrowDown'];
  navigation.press = event => {
    if (!HELD.includes(event.code) || event.altKey || event.metaKey) return false;
    pressed.add(event.code);
    viewer.flight.stop();
    navigation.interrupted?.();
    return true;
  };
  let fast = false, slow = false, last = 0;
  addEventListener('keydown', event => { fast = event.shiftKey; slow = event.ctrlKey; });
  addEventListener('keyup', event => { pressed.delete(event.code); fast = event.shiftKey; slow = event.ctrlKey; });
  addEventListener('blur', () => pressed.clear());
  viewer.steps.push(now => {
    const seconds = Math.min(0.05, (now - last) / 1000);
    last = now;
    if (!pressed.size) return;
    const held = (plus, minus) => Number(pressed.has(plus)) - Number(pressed.has(minus));
    const step = seconds * camera.reach * 0.45 * navigation.speed * (fast ? 4 : slow ? 0.25 : 1);
    camera.move(step * held('KeyD', 'KeyA'), step * held('KeyE', 'KeyQ'), step * held('KeyW', 'KeyS'));
    const turn = 1.1 * seconds, yaw = turn * held('ArrowLeft', 'ArrowRight'), pitch = turn * held('ArrowUp', 'ArrowDown');
    if (navigation.flying) camera.look(yaw, pitch); else camera.orbit(yaw, pitch);
    viewer.moved();
  });
  return navigation;
}
