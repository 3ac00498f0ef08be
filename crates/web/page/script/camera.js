// The visitor's camera: eye, rotation, vertical field of view, and the point of interest in front, around
// which the camera orbits. World up is +z until the visitor levels it, and `upright` is the up that a reset
// restores. Ups and views belong to the page, never to the scene.

const DEGREE = Math.PI / 180;
// Greatest distance of the visitor from the nearest photograph, as a multiple of half the scene's size.
const FARTHEST = 2;

// The photograph that the page opens at: the training view nearest to the centre of all cameras, because a
// capture's first view lies at its edge. With one or two photographs it is the first.
function openingView(cameras) {
  const trained = cameras.map((view, i) => [view, i]).filter(([view]) => !view.heldOut);
  if (cameras.length < 3 || !trained.length) return cameras.length ? 0 : -1;
  const middle = scaled(cameras.reduce((sum, view) => add(sum, view.eye), [0, 0, 0]), 1 / cameras.length);
  const away = ([view]) => norm(subtract(view.eye, middle));
  return trained.reduce((best, one) => (away(one) < away(best) ? one : best))[1];
}

// `aspect()` is the width of the picture through its height.
function makeCamera(header, aspect) {
  const { low, high } = header.bounds;
  const middle = scaled(add(low, high), 0.5), reach = Math.max(norm(subtract(high, low)) / 2, 1e-3);
  const first = header.cameras[openingView(header.cameras)];
  const camera = { eye: [0, 0, 0], rotation: looking([0, 1, 0], [0, 0, 1]), fov: 50, focus: reach, up: [0, 0, 1], upright: [0, 0, 1], reach };

  camera.state = () => ({ eye: [...camera.eye], rotation: camera.rotation.map(row => [...row]), fov: camera.fov, focus: camera.focus });
  camera.set = ({ eye, rotation, fov, focus }) => {
    Object.assign(camera, { eye: [...eye], rotation: orthonormal(rotation), fov: fov ?? camera.fov, focus: focus ?? camera.focus });
  };
  // The pinhole camera of a picture of this size: square pixels, principal point in the middle.
  camera.pinhole = (width, height) => {
    const f = height / 2 / Math.tan(camera.fov * DEGREE / 2);
    return { eye: camera.eye, rotation: camera.rotation, lens: [f, f, width / 2, height / 2], width, height };
  };
  camera.target = () => along(camera.eye, camera.rotation[2], camera.focus);
  // A view of the whole scene in the present direction.
  camera.framing = () => {
    const half = Math.atan(Math.tan(camera.fov * DEGREE / 2) * Math.min(1, aspect()));
    const focus = reach / Math.sin(Math.min(half, 1.2));
    return { eye: along(middle, camera.rotation[2], -focus), rotation: camera.rotation, fov: camera.fov, focus };
  };
  // The camera of a photograph, with a field of view that has the whole photograph in it.
  camera.atView = view => {
    const slope = Math.max(view.height / 2 / view.lens[1], view.width / 2 / view.lens[0] / aspect());
    return { eye: view.eye, rotation: view.rotation, focus: view.focus || reach, fov: 2 * Math.atan(slope) / DEGREE };
  };
  // The distance from the nearest photograph is limited: farther away nothing is known well.
  const eyes = header.cameras.length < 3 ? [] : header.cameras.map(view => view.eye), most = FARTHEST * reach;
  camera.stay = () => {
    if (!eyes.length) return;
    const nearest = eyes.reduce((a, b) => (norm(subtract(b, camera.eye)) < norm(subtract(a, camera.eye)) ? b : a));
    const away = subtract(camera.eye, nearest), far = norm(away);
    if (far > most) camera.eye = along(nearest, away, most / far);
  };
  camera.home = () => {
    if (first) return camera.atView(first);
    const rotation = looking([0.5, 0.8, -0.35], [0, 0, 1]);
    return { eye: along(middle, rotation[2], -1.2 * reach), rotation, fov: 50, focus: 1.2 * reach };
  };
  camera.levelled = () => ({ ...camera.state(), rotation: looking(camera.rotation[2], camera.up) });

  camera.orbit = (yaw, pitch) => {
    const target = camera.target();
    camera.look(yaw, pitch);
    camera.eye = along(target, camera.rotation[2], -camera.focus);
  };
  // Turns without moving: yaw about up, pitch about the right axis, never over the poles.
  camera.look = (yaw, pitch) => {
    const tilt = Math.asin(clamp(dot(camera.rotation[2], camera.up), -1, 1)), most = 88 * DEGREE;
    const allowed = clamp(tilt + pitch, Math.min(-most, tilt), Math.max(most, tilt)) - tilt;
    let rows = camera.rotation.map(row => turned(row, camera.rotation[0], allowed));
    rows = rows.map(row => turned(row, camera.up, yaw));
    camera.rotation = orthonormal(rows);
  };
  camera.move = (right, up, forward) => {
    const [r, d, f] = camera.rotation;
    camera.eye = along(along(along(camera.eye, r, right), d, -up), f, forward);
  };
  camera.roll = angle => { camera.rotation = camera.rotation.map(row => turned(row, camera.rotation[2], angle)); };
  // Moves towards a point of the picture, given as a direction.
  camera.zoom = (factor, direction = camera.rotation[2]) => {
    const step = camera.focus * (1 - factor);
    camera.eye = along(camera.eye, direction, step);
    camera.focus = clamp(camera.focus * factor, 1e-3 * reach, 20 * reach);
  };
  // Pixel (from the top left corner) and depth of a world point; null behind the eye.
  camera.project = (point, width, height) => {
    const away = subtract(point, camera.eye), z = dot(camera.rotation[2], away);
    if (z <= 1e-3) return null;
    const f = height / 2 / Math.tan(camera.fov * DEGREE / 2);
    return [width / 2 + f * dot(camera.rotation[0], away) / z, height / 2 + f * dot(camera.rotation[1], away) / z, z];
  };
  // World direction through a pixel, scaled to depth 1.
  camera.through = (x, y, width, height) => {
    const f = height / 2 / Math.tan(camera.fov * DEGREE / 2);
    return add(camera.rotation[2], add(scaled(camera.rotation[0], (x - width / 2) / f), scaled(camera.rotation[1], (y - height / 2) / f)));
  };
  camera.set(camera.home());
  return camera;
}
