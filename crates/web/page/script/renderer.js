// Draws the scene: water maps, open water, Gaussians back to front, then to the screen. A picture may have
// two halves with different modes; each half is drawn separately, inside a scissor.
//
// A camera is { eye, rotation, lens: [fx, fy, cx, cy], width, height } in pixels. A look is { mode, strength,
// water, white }, where `white` holds the gains of each mode that has some.

// Slopes in the projection's derivative may leave the picture by this share of half its size.
const NO_LIMITS = 0.3;

function makeRenderer(canvas, scene) {
  const gl = canvas.getContext('webgl2', { antialias: false, alpha: false, depth: false, preserveDrawingBuffer: true, powerPreference: 'high-performance' });
  if (!gl) throw new Error('this browser has no WebGL 2');
  if (!gl.getExtension('EXT_color_buffer_float') && !gl.getExtension('EXT_color_buffer_half_float'))
    throw new Error('this graphics driver cannot draw into float pictures');
  const { header } = scene, { medium, enhancement } = header;
  const programs = {
    water: makeProgram(gl, 'screen.vert', 'water.frag'),
    background: makeProgram(gl, 'screen.vert', 'background.frag'),
    splat: makeProgram(gl, 'splat.vert', 'splat.frag'),
    show: makeProgram(gl, 'screen.vert', 'show.frag'),
  };
  const texels = 3 * PER_ROW;
  let geometry, harmonics, evidence, degree;
  // Takes the Gaussians of a scene; those of the complete scene replace those with which the page begins.
  function load(data) {
    for (const old of new Set([geometry, harmonics, evidence])) gl.deleteTexture(old ?? null);
    geometry = wordTexture(gl, data.geometry, texels, data.rows);
    harmonics = data.harmonics ? wordTexture(gl, data.harmonics, texels, data.rows) : geometry;
    evidence = data.evidence ? byteTexture(gl, data.evidence, PER_ROW, data.rows) : null;
    degree = data.degree;
  }
  load(scene);
  const maps = makeTarget(gl, 3), sum = makeTarget(gl, 1);
  const cubes = medium.side ? bakedWater(gl, scene.cube, medium.side) : [];
  const noCube = makeTexture(gl, gl.NEAREST, gl.TEXTURE_CUBE_MAP);

  const screenArray = gl.createVertexArray(), splatArray = gl.createVertexArray(), order = gl.createBuffer();
  gl.bindVertexArray(splatArray);
  gl.bindBuffer(gl.ARRAY_BUFFER, order);
  gl.enableVertexAttribArray(0);
  gl.vertexAttribIPointer(0, 1, gl.UNSIGNED_INT, 0, 0);
  gl.vertexAttribDivisor(0, 1);
  let ordered = 0;

  const fullScreen = () => { gl.bindVertexArray(screenArray); gl.drawArrays(gl.TRIANGLES, 0, 3); };
  const pose = camera => ({ right: camera.rotation[0], down: camera.rotation[1], forward: camera.rotation[2], lens: camera.lens });
  const affine = strength => new Float32Array(enhancement.affine.map(v => strength * v));

  function drawWater(camera, look, amount) {
    const { water } = programs, graded = MODES[look.mode].graded && enhancement.water;
    gl.bindFramebuffer(gl.FRAMEBUFFER, maps.buffer);
    gl.disable(gl.BLEND);
    water.use();
    water.ints({ kind: medium.side ? 2 : 1, bands: (medium.degree + 1) ** 2, graded });
    water.floats({ ...pose(camera), height: camera.height, amount });
    ['cubeColor', 'cubeBackscatter', 'cubeAttenuation'].forEach((name, i) => water.texture(name, i, cubes[i] || noCube, gl.TEXTURE_CUBE_MAP));
    if (!medium.side) water.arrays(3, { harmonic: new Float32Array(aggregated(medium, camera.eye)) });
    if (graded) {
      const { gains, biases, ratios } = guideTable(enhancement, camera.eye, look.strength);
      water.arrays(3, { gains, biases });
      water.arrays(4, { affine: affine(look.strength) });
      water.floats({ guide: enhancement.guide, ratios, kept: enhancement.keptWater.map(k => 1 - look.strength * (1 - k)) });
    }
    fullScreen();
  }

  function drawHalf(camera, look) {
    const mode = MODES[look.mode], amount = mode.water && medium.kind !== 'none' ? look.water : 0;
    if (amount > 0) drawWater(camera, look, amount);
    gl.bindFramebuffer(gl.FRAMEBUFFER, sum.buffer);
    gl.disable(gl.BLEND);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    if (amount > 0 && mode.veil) {
      programs.background.use();
      programs.background.texture('waterColor', 0, maps.textures[0]);
      programs.background.floats({ amount });
      fullScreen();
    }
    const { splat } = programs, [fx, fy, cx, cy] = camera.lens, { width, height } = camera;
    const [mx, my] = [NO_LIMITS * width / 2 / fx, NO_LIMITS * height / 2 / fy];
    splat.use();
    splat.ints({ perRow: PER_ROW, degree, known: evidence !== null, graded: mode.graded, watery: amount > 0, depthOnly: !!mode.depth });
    splat.floats({
      ...pose(camera), eye: camera.eye, size: [width, height], height, objects: mode.objects, veil: mode.veil, strength: look.strength,
      limits: [-(cx / fx + mx), (width - cx) / fx + mx, -(cy / fy + my), (height - cy) / fy + my],
    });
    if (mode.graded) splat.arrays(4, { affine: affine(look.strength) });
    splat.texture('geometry', 0, geometry);
    splat.texture('harmonicBytes', 1, harmonics);
    splat.texture('evidence', 5, evidence ?? geometry);
    ['waterColor', 'waterBackscatter', 'waterAttenuation'].forEach((name, i) => splat.texture(name, 2 + i, maps.textures[i]));
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.bindVertexArray(splatArray);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, ordered);
  }

  // Fills the float picture; `at` in [0, 1] is the place where `left` ends and `look` begins. A `box` [x, y,
  // width, height], rows from the top, limits the drawing to itself.
  function compose(camera, look, left, at, box = null) {
    const { width, height } = camera;
    maps.resize(width, height);
    sum.resize(width, height);
    gl.viewport(0, 0, width, height);
    const cut = left ? Math.round(at * width) : 0;
    const halves = [[left, 0, cut], [look, cut, width]].filter(([, from, to]) => to > from);
    gl.enable(gl.SCISSOR_TEST);
    for (const [half, from, to] of halves) {
      if (box) gl.scissor(box[0], height - box[1] - box[3], box[2], box[3]); else gl.scissor(from, 0, to - from, height);
      drawHalf(camera, half);
    }
    return halves;
  }

  return {
    gl,
    load,
    setOrder(sorted) {
      gl.bindBuffer(gl.ARRAY_BUFFER, order);
      gl.bufferData(gl.ARRAY_BUFFER, sorted, gl.DYNAMIC_DRAW);
      ordered = sorted.length;
    },
    draw(camera, look, left, at, range) {
      const halves = compose(camera, look, left, at), { show } = programs;
      gl.bindFramebuffer(gl.FRAMEBUFFER, null);
      gl.disable(gl.BLEND);
      show.use();
      show.texture('picture', 0, sum.textures[0]);
      show.floats({ range });
      for (const [half, from, to] of halves) {
        gl.scissor(from, 0, to - from, camera.height);
        show.ints({ depthOnly: !!MODES[half.mode].depth });
        show.floats({ gains: gainsOf(half) });
        fullScreen();
      }
      gl.disable(gl.SCISSOR_TEST);
    },
    // The float picture of one look, or of a box [x, y, width, height] of it: RGBA per pixel, rows from the
    // top. For depth its values are the mean depth, and 0 where nothing is.
    picture(camera, look, box = null) {
      compose(camera, look, null, 0, box);
      gl.disable(gl.SCISSOR_TEST);
      const [left, top, width, height] = box ?? [0, 0, camera.width, camera.height];
      const raw = new Float32Array(4 * width * height), out = new Float32Array(raw.length);
      gl.bindFramebuffer(gl.FRAMEBUFFER, sum.buffer);
      gl.readPixels(left, camera.height - top - height, width, height, gl.RGBA, gl.FLOAT, raw);
      for (let y = 0; y < height; y++) out.set(raw.subarray(4 * width * (height - 1 - y), 4 * width * (height - y)), 4 * width * y);
      const gains = gainsOf(look);
      if (gains !== NO_GAINS) for (let i = 0; i < out.length; i++) if (i % 4 < 3) out[i] *= gains[i % 4];
      if (MODES[look.mode].depth) for (let i = 0; i < out.length; i += 4) out[i] = out[i] / Math.max(out[i + 3], 1e-6);
      return out;
    },
  };
}

// The three cubes of a water that is a network over directions, baked by the exporter. Each quantity has six
// faces of half floats, RGBA.
function bakedWater(gl, bytes, side) {
  const halves = new Uint16Array(bytes.slice().buffer), face = 4 * side * side;
  return [0, 1, 2].map(quantity => {
    const texture = makeTexture(gl, gl.LINEAR, gl.TEXTURE_CUBE_MAP);
    for (let f = 0; f < 6; f++)
      gl.texImage2D(gl.TEXTURE_CUBE_MAP_POSITIVE_X + f, 0, gl.RGBA16F, side, side, 0, gl.RGBA, gl.HALF_FLOAT, halves.subarray((6 * quantity + f) * face, (6 * quantity + f + 1) * face));
    return texture;
  });
}
