// Draws over the picture: the cameras as small pyramids, measured points with their lines, the path. All of
// them follow the camera.

function makeOverlay(canvas, viewer) {
  const context = canvas.getContext('2d'), drawers = [], { camera } = viewer;
  let width = 0, height = 0;
  const overlay = {
    add: draw => drawers.push(draw),
    // A line between world points, interrupted where it passes behind the eye.
    line(points, style, thickness = 1.5, dashed = false) {
      context.strokeStyle = style;
      context.lineWidth = thickness;
      context.setLineDash(dashed ? [5, 5] : []);
      context.beginPath();
      let open = false;
      for (const point of points) {
        const p = camera.project(point, width, height);
        if (p && open) context.lineTo(p[0], p[1]); else if (p) context.moveTo(p[0], p[1]);
        open = p !== null;
      }
      context.stroke();
    },
    dot(point, style, radius = 5) {
      const p = camera.project(point, width, height);
      if (!p) return;
      context.setLineDash([]);
      context.fillStyle = style;
      context.strokeStyle = '#06202bcc';
      context.lineWidth = 2;
      context.beginPath();
      context.arc(p[0], p[1], radius, 0, 2 * Math.PI);
      context.fill();
      context.stroke();
    },
    // A cross in the middle of the picture.
    cross(style, radius = 9) {
      const [x, y] = [width / 2, height / 2];
      context.setLineDash([]);
      context.beginPath();
      for (const [dx, dy] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) { context.moveTo(x + 3 * dx, y + 3 * dy); context.lineTo(x + radius * dx, y + radius * dy); }
      for (const [color, thickness] of [['#06202bcc', 4], [style, 2]]) { context.strokeStyle = color; context.lineWidth = thickness; context.stroke(); }
    },
    label(point, text) {
      const p = camera.project(point, width, height);
      if (!p) return;
      context.font = '600 13px system-ui, sans-serif';
      const w = context.measureText(text).width + 16;
      context.fillStyle = '#06202bd9';
      context.beginPath();
      context.roundRect(p[0] - w / 2, p[1] - 34, w, 24, 12);
      context.fill();
      context.fillStyle = '#fff';
      context.textAlign = 'center';
      context.textBaseline = 'middle';
      context.fillText(text, p[0], p[1] - 22);
    },
  };
  viewer.on('frame', () => {
    const ratio = Math.min(window.devicePixelRatio || 1, 2);
    [width, height] = [canvas.clientWidth, canvas.clientHeight];
    canvas.width = Math.round(width * ratio);
    canvas.height = Math.round(height * ratio);
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    for (const draw of drawers) draw(overlay);
  });
  return overlay;
}
