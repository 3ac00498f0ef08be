// A camera and its look as stored in files. Files use the COLMAP frame, x_scene = scale (R x) + t, so they
// stay valid when a scene is trained again.

// Rotation rows and centre in the COLMAP frame, and back in the frame of the scene.
function toColmap(frame, { eye, rotation }) {
  const r = k => [frame.rotation[k], frame.rotation[3 + k], frame.rotation[6 + k]];
  const moved = scaled(subtract(eye, frame.translation), 1 / frame.scale);
  return { center: [0, 1, 2].map(k => dot(r(k), moved)), rotation: rotation.map(row => [0, 1, 2].map(k => dot(row, r(k)))) };
}
function fromColmap(frame, { center, rotation }) {
  const r = k => frame.rotation.slice(3 * k, 3 * k + 3);
  return {
    eye: [0, 1, 2].map(k => frame.scale * dot(r(k), center) + frame.translation[k]),
    rotation: orthonormal(rotation.map(row => [0, 1, 2].map(k => dot(row, r(k))))),
  };
}

const shotForFile = (shot, frame) => ({
  ...toColmap(frame, shot), vertical_fov_degrees: shot.fov, focus: shot.focus / frame.scale, mode: shot.mode, strength: shot.strength, water: shot.water,
});

function shotOfFile(shot, frame, what) {
  const numbers = (list, count) => Array.isArray(list) && list.length === count && list.every(Number.isFinite);
  const good = numbers(shot?.center, 3) && Array.isArray(shot.rotation) && shot.rotation.length === 3 && shot.rotation.every(row => numbers(row, 3))
    && shot.vertical_fov_degrees > 0 && shot.vertical_fov_degrees < 180;
  if (!good) throw new Error(`${what}: expected center, rotation (three rows) and vertical_fov_degrees`);
  const share = value => (Number.isFinite(value) ? clamp(value, 0, 1) : 1);
  return {
    ...fromColmap(frame, shot), fov: shot.vertical_fov_degrees, focus: (shot.focus > 0 ? shot.focus : 1) * frame.scale,
    mode: MODES[shot.mode] ? shot.mode : 'reconstruction', strength: share(shot.strength), water: share(shot.water),
  };
}

// Fails unless a file has this format and version and holds the list.
function checkFile(file, format, what, list) {
  if (file?.format !== format) throw new Error(`this is no ${what}: its "format" is not "${format}"`);
  if (file.version !== 1) throw new Error(`version ${file.version} of a ${what}; this page reads version 1`);
  if (!Array.isArray(file[list])) throw new Error(`the ${what} has no ${list}`);
}
