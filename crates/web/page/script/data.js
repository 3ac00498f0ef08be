// The scene's data: parts in base64 -> gzip -> sections of bytes -> textures.
//
// Numbers are stored byte by byte in planes (the first byte of every Gaussian, then the second ...), which
// compresses better. Here the bytes are put side by side again, in the layout that the shaders read. The
// header lists the sections in their order. The first picture needs `geometry` and `cube` only: the Gaussians
// that matter most, without their harmonics. `rest`, `harmonics` and the photographs come later.

const GEOMETRY_BYTES = 48, EVIDENCE_BYTES = 4, HARMONIC_BYTES = 48, PER_ROW = 512;

function bytesOfBase64(text) {
  if (Uint8Array.fromBase64) return Uint8Array.fromBase64(text);
  const raw = atob(text), bytes = new Uint8Array(raw.length);
  for (let i = 0; i < raw.length; i++) bytes[i] = raw.charCodeAt(i);
  return bytes;
}

async function unpacked(parts) {
  const packed = new Blob(parts.map(bytesOfBase64)).stream().pipeThrough(new DecompressionStream('gzip'));
  return new Uint8Array(await new Response(packed).arrayBuffer());
}

// Puts the bytes of `count` records from planes into `out`, after the first `before` records of `stride` bytes.
function place(out, before, planes, count, from, stored, stride, at = k => k) {
  for (let k = 0; k < stored; k++) {
    const plane = planes.subarray((from + k) * count, (from + k + 1) * count);
    for (let i = 0, to = before * stride + at(k); i < count; i++, to += stride) out[to] = plane[i];
  }
}

// The Gaussians of some sections of geometry, with their harmonics or without.
function sceneData(header, geometries, planes, cube) {
  const stored = GEOMETRY_BYTES + (header.evidence ? EVIDENCE_BYTES : 0), counts = geometries.map(section => section.length / stored);
  const count = counts.reduce((a, b) => a + b, 0), rows = Math.max(1, Math.ceil(count / PER_ROW));
  const geometry = new Uint8Array(rows * PER_ROW * GEOMETRY_BYTES), evidence = header.evidence ? new Uint8Array(EVIDENCE_BYTES * count) : null;
  geometries.reduce((before, section, i) => {
    place(geometry, before, section, counts[i], 0, GEOMETRY_BYTES, GEOMETRY_BYTES);
    if (evidence) place(evidence, before, section, counts[i], GEOMETRY_BYTES, EVIDENCE_BYTES, EVIDENCE_BYTES);
    return before + counts[i];
  }, 0);
  const harmonics = planes ? new Uint8Array(rows * PER_ROW * HARMONIC_BYTES) : null, own = header.harmonicBytes;
  // The last two stored bytes are the scale; the shader reads it at the end of the record.
  if (harmonics) place(harmonics, 0, planes, count, 0, own, HARMONIC_BYTES, k => (k < own - 2 ? k : HARMONIC_BYTES - own + k));
  const floats = new Float32Array(geometry.buffer), centres = new Float32Array(3 * count);
  for (let i = 0; i < count; i++) for (let a = 0; a < 3; a++) centres[3 * i + a] = floats[12 * i + a];
  return { header, count, rows, geometry, evidence, harmonics, degree: harmonics ? header.degree : 0, centres, cube };
}

const addPhotographs = (header, list) => list.forEach(([photo, enhanced], i) => Object.assign(header.cameras[i], { photo, enhanced }));

// Reads a section by its name. Parts are elements of the page, or scripts beside the page have put them into a
// list; both are in the order of the sections. A page from a server gets its sections from there.
function sectionsOf(header, server) {
  if (server) {
    return async name => {
      const packed = (await server.ask('/section', { name })).body.pipeThrough(new DecompressionStream('gzip'));
      return new Uint8Array(await new Response(packed).arrayBuffer());
    };
  }
  return async name => {
    const at = header.sections.findIndex(section => section.name === name), first = header.sections.slice(0, at).reduce((sum, { parts }) => sum + parts, 0);
    const parts = window.use3dParts || [...document.querySelectorAll('script[data-part]')].map(s => s.textContent.trim()), count = header.sections[at].parts;
    if (parts.length < first + count) throw new Error('a part of its data is missing; keep the folder that came with the page beside it');
    return unpacked(parts.slice(first, first + count));
  };
}

// The scene with which the page begins. Its `complete` resolves to all of it as soon as that is there. If the
// server draws the pictures, there are no Gaussians.
async function loadScene(server) {
  let header;
  if (server) {
    const beginning = await server.begin();
    header = beginning.header;
    if (beginning.drawn === 'server' || server.where === 'server' || (!server.where && drawsInSoftware())) {
      if (header.sections.length) addPhotographs(header, JSON.parse(new TextDecoder().decode(await sectionsOf(header, server)('photographs'))));
      else addPhotographs(header, header.photographs);
      return { header, server };
    }
  } else header = JSON.parse(element('scene').textContent);
  const read = sectionsOf(header, server), has = name => header.sections.some(section => section.name === name);
  const first = await read('geometry'), cube = has('cube') ? await read('cube') : undefined;
  const scene = sceneData(header, [first], null, cube);
  scene.complete = async () => {
    // The script runs before the browser has read the rest of the page.
    if (!server && document.readyState === 'loading') await new Promise(done => document.addEventListener('DOMContentLoaded', done));
    const rest = has('rest') ? [await read('rest')] : [], harmonics = has('harmonics') ? await read('harmonics') : null;
    addPhotographs(header, server ? JSON.parse(new TextDecoder().decode(await read('photographs'))) : JSON.parse(element('photographs').textContent));
    return rest.length || harmonics ? sceneData(header, [first, ...rest], harmonics, cube) : null;
  };
  return scene;
}
