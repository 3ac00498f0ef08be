// Moves the camera from one view to another in 1.1 seconds, starting and ending slowly. If the visitor's
// system asks for less motion, the camera jumps.

const calm = () => matchMedia('(prefers-reduced-motion: reduce)').matches;

function makeFlight(camera, changed) {
  let flight = null;
  const ease = t => t * t * (3 - 2 * t);
  return {
    to(goal, seconds = 1.1) {
      if (calm() || seconds <= 0) { flight = null; camera.set(goal); changed(); return; }
      flight = { from: camera.state(), goal, seconds, started: null };
      changed();
    },
    stop() { flight = null; },
    busy: () => flight !== null,
    step(now) {
      if (!flight) return;
      flight.started ??= now;
      const t = ease(clamp((now - flight.started) / 1000 / flight.seconds, 0, 1)), { from, goal } = flight;
      camera.set({
        eye: [0, 1, 2].map(i => mix(from.eye[i], goal.eye[i], t)),
        rotation: slerp(from.rotation, goal.rotation, t),
        fov: mix(from.fov, goal.fov ?? from.fov, t),
        focus: mix(from.focus, goal.focus ?? from.focus, t),
      });
      if (t >= 1) { camera.set(goal); flight = null; }
      changed();
    },
  };
}
