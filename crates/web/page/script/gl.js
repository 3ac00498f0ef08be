// Small helpers for WebGL2: programs whose uniforms are set by name, textures, render targets.

const shaderText = name => document.getElementById(name).textContent.trim().replace(
  /^\/\/#include (\w+)$/gm, (_, part) => document.getElementById(part).textContent.trim());

function makeProgram(gl, vertex, fragment) {
  const program = gl.createProgram();
  for (const [kind, name] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, shaderText(name));
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS) && !gl.isContextLost())
      throw new Error(`${name}: ${gl.getShaderInfoLog(shader)}`);
    gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost())
    throw new Error(`${vertex} with ${fragment}: ${gl.getProgramInfoLog(program)}`);
  const places = {};
  const place = name => (places[name] ??= gl.getUniformLocation(program, name));
  // Sets uniforms. `ints` takes numbers and booleans, `floats` takes numbers, and vectors as arrays.
  return {
    use() { gl.useProgram(program); },
    ints(values) { for (const name in values) gl.uniform1i(place(name), Number(values[name])); },
    floats(values) {
      for (const name in values) {
        const v = values[name];
        if (typeof v === 'number') gl.uniform1f(place(name), v); else gl[`uniform${v.length}fv`](place(name), v);
      }
    },
    arrays(size, values) { for (const name in values) gl[`uniform${size}fv`](place(name), values[name]); },
    texture(name, at, texture, kind = gl.TEXTURE_2D) {
      gl.activeTexture(gl.TEXTURE0 + at);
      gl.bindTexture(kind, texture);
      gl.uniform1i(place(name), at);
    },
  };
}

function makeTexture(gl, filter = gl.NEAREST, kind = gl.TEXTURE_2D) {
  const texture = gl.createTexture();
  gl.bindTexture(kind, texture);
  for (const side of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(kind, side, gl.CLAMP_TO_EDGE);
  for (const zoom of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(kind, zoom, filter);
  return texture;
}

// A texture of whole numbers: `rows` rows of `texels` texels with four words each.
function wordTexture(gl, bytes, texels, rows) {
  const texture = makeTexture(gl);
  gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32UI, texels, rows, 0, gl.RGBA_INTEGER, gl.UNSIGNED_INT, new Uint32Array(bytes.buffer));
  return texture;
}

// A texture of whole numbers, one texel of four bytes for each Gaussian.
function byteTexture(gl, bytes, texels, rows) {
  const texture = makeTexture(gl), filled = new Uint8Array(4 * texels * rows);
  filled.set(bytes);
  gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8UI, texels, rows, 0, gl.RGBA_INTEGER, gl.UNSIGNED_BYTE, filled);
  return texture;
}

// A framebuffer with `count` half-float pictures; `resize` gives all of them a new size.
function makeTarget(gl, count) {
  const target = { buffer: gl.createFramebuffer(), textures: Array.from({ length: count }, () => makeTexture(gl)), width: 0, height: 0 };
  target.resize = (width, height) => {
    if (target.width === width && target.height === height) return;
    Object.assign(target, { width, height });
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.buffer);
    target.textures.forEach((texture, i) => {
      gl.bindTexture(gl.TEXTURE_2D, texture);
      gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA16F, width, height, 0, gl.RGBA, gl.HALF_FLOAT, null);
      gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0 + i, gl.TEXTURE_2D, texture, 0);
    });
    gl.drawBuffers(target.textures.map((_, i) => gl.COLOR_ATTACHMENT0 + i));
  };
  return target;
}
