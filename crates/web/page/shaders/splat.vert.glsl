#version 300 es
// One Gaussian as a quad: projection, colour, grade. The formulas are those of the program's own renderer
// (EWA splatting):
//
//   X = R (mean - eye) = (x, y, z),  J = [[fx/z, 0, -fx tx/z], [0, fy/z, -fy ty/z]],
//   cov = J R S Rt Jt + 0.3 I   (pixels squared)
//
// with the slopes tx, ty clamped in J alone. A quad covers all pixels with alpha >= 1/255. Each Gaussian has
// six texels. Three hold the geometry: the centre as floats; quaternion, logarithms of the sizes, opacity,
// constant harmonics and grade as 16-bit numbers. Three hold the other harmonics: 45 signed bytes and their
// scale.
//
// The photographs' evidence says from where a Gaussian was seen: a cone about the direction m with the half
// angle t, and the greatest distance. In other directions a Gaussian fades; a loose one (128 in the
// byte of the angle) also fades farther away. One that no photograph saw is not drawn.
//
// The colour of a view is c = max(0, sum_k Y_k sh_k + 1/2). An enhanced colour is c+ = e^{s a} (c + s (dA c +
// b_g)) + s b with the strength s; s = 0 is exactly the reconstruction.
precision highp float;
precision highp int;
precision highp usampler2D;

layout(location = 0) in uint index;
uniform usampler2D geometry, harmonicBytes, evidence;
uniform bool known;             // false: there is no evidence
uniform int perRow;             // Gaussians per row of the textures
uniform int degree;
uniform vec3 eye, right, down, forward;
uniform vec4 lens;              // fx, fy, cx, cy
uniform vec2 size;              // pixels
uniform vec4 limits;            // slopes: left, right, top, bottom
uniform bool graded;
uniform float strength;
uniform vec4 affine[3];         // rows (dA | b_g), times the strength

out vec2 offset;                // standard deviations from the centre
flat out vec3 color;
flat out float opacity, depth, farthest;

//#include harmonics

const vec2 CORNERS[4] = vec2[4](vec2(-1.0, -1.0), vec2(1.0, -1.0), vec2(-1.0, 1.0), vec2(1.0, 1.0));

float signedByte(uvec4 words[3], int at) {
  uint word = words[at / 16][(at / 4) % 4];
  return float(int(word << uint(24 - 8 * (at % 4))) >> 24) / 127.0;
}

vec3 viewColor(ivec2 texel, vec3 constant, vec3 direction) {
  float y[16];
  harmonics(direction, y);
  vec3 c = vec3(0.5) + y[0] * constant;
  if (degree > 0) {
    uvec4 words[3];
    for (int k = 0; k < 3; k++) words[k] = texelFetch(harmonicBytes, texel + ivec2(k, 0), 0);
    float scale = unpackHalf2x16(words[2].w >> 16).x;   // bytes 46 and 47
    int last = (degree + 1) * (degree + 1);
    for (int b = 1; b < 16; b++) {
      if (b >= last) break;
      int at = 3 * (b - 1);
      c += y[b] * scale * vec3(signedByte(words, at), signedByte(words, at + 1), signedByte(words, at + 2));
    }
  }
  return max(c, 0.0);
}

// The share that is shown of a Gaussian in this direction; sets the greatest distance of the water.
float shownShare(ivec2 at, vec3 direction, float far) {
  const float FADES = 0.25;       // radians beyond the cone
  uvec4 bytes = texelFetch(evidence, at, 0);
  if (bytes.w == 0u) return 0.0;
  farthest = exp(float(bytes.w) / 18.0 - 7.0);
  vec3 m = vec3(vec2(bytes.xy) / 127.5 - 1.0, 0.0);
  m.z = 1.0 - abs(m.x) - abs(m.y);
  if (m.z < 0.0) m.xy = (1.0 - abs(m.yx)) * vec2(m.x < 0.0 ? -1.0 : 1.0, m.y < 0.0 ? -1.0 : 1.0);
  float cone = float(bytes.z & 127u) / 127.0 * 3.14159265;
  float full = cos(cone), gone = cone + FADES > 3.14159265 ? -1.0001 : cos(cone + FADES);
  float t = clamp((dot(normalize(m), direction) - gone) / max(full - gone, 1e-6), 0.0, 1.0);
  t = t * t * (3.0 - 2.0 * t);
  return bytes.z < 128u ? t : t * (1.0 - smoothstep(0.95 * farthest, 1.3 * farthest, far));
}

mat3 turn(vec4 q) {             // w, x, y, z
  float w = q.x, x = q.y, y = q.z, z = q.w;
  return mat3(
    1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y),
    2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x),
    2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y));
}

void main() {
  gl_Position = vec4(2.0, 2.0, 2.0, 1.0);     // outside the picture; replaced if the Gaussian is visible
  offset = vec2(0.0);
  color = vec3(0.0);
  int row = int(index) / perRow;
  ivec2 texel = ivec2(3 * (int(index) - row * perRow), row);
  uvec4 first = texelFetch(geometry, texel, 0);
  uvec4 second = texelFetch(geometry, texel + ivec2(1, 0), 0);
  uvec4 third = texelFetch(geometry, texel + ivec2(2, 0), 0);

  vec3 mean = uintBitsToFloat(first.xyz);
  vec3 away = mean - eye;
  vec3 X = vec3(dot(right, away), dot(down, away), dot(forward, away));
  depth = X.z;
  opacity = float(second.w >> 16) / 65535.0;
  farthest = 1e9;
  if (!(X.z >= 0.01 && X.z <= 1e4)) return;
  if (known) opacity *= shownShare(ivec2(texel.x / 3, row), normalize(away), length(away));
  if (opacity < 1.0 / 255.0) return;

  vec4 q = vec4(float(int(second.x << 16) >> 16), float(int(second.x) >> 16), float(int(second.y << 16) >> 16), float(int(second.y) >> 16));
  vec3 logs = vec3(float(second.z & 0xffffu), float(second.z >> 16), float(second.w & 0xffffu)) * (24.0 / 65535.0) - 18.0;
  vec3 s = exp(logs);
  mat3 axesWorld = turn(normalize(q));

  vec2 slope = clamp(X.xy / X.z, limits.xz, limits.yw);
  vec3 jx = (lens.x / X.z) * (right - slope.x * forward);
  vec3 jy = (lens.y / X.z) * (down - slope.y * forward);
  vec3 a = (jx * axesWorld) * s, b = (jy * axesWorld) * s;
  float aa = dot(a, a), bb = dot(b, b), ab = dot(a, b);
  vec3 across = cross(a, b);
  float xx = aa + 0.3, yy = bb + 0.3;
  // |a x b|^2 instead of aa bb - ab^2: no cancellation for needles.
  float det = dot(across, across) + 0.3 * (aa + bb) + 0.09;
  float half_ = 0.5 * (xx - yy), spread = length(vec2(half_, ab));
  float large = 0.5 * (xx + yy) + spread, small_ = det / large;
  vec2 along = half_ >= 0.0 ? vec2(large - yy, ab) : vec2(ab, large - xx);
  along = dot(along, along) > 0.0 ? normalize(along) : vec2(1.0, 0.0);

  float reach = sqrt(2.0 * log(255.0 * opacity)) + 1e-3;
  offset = CORNERS[gl_VertexID] * reach;
  vec2 centre = lens.xy * (X.xy / X.z) + lens.zw;
  vec2 pixel = centre + offset.x * sqrt(large) * along + offset.y * sqrt(small_) * vec2(-along.y, along.x);

  vec3 c = viewColor(texel, vec3(unpackHalf2x16(third.x), unpackHalf2x16(third.y).x), normalize(away));
  if (graded) {
    vec3 gain = vec3(unpackHalf2x16(third.y).y, unpackHalf2x16(third.z));
    vec3 bias = vec3(unpackHalf2x16(third.w), unpackHalf2x16(first.w).x);
    vec4 c1 = vec4(c, 1.0);
    c = exp(strength * gain) * (c + vec3(dot(affine[0], c1), dot(affine[1], c1), dot(affine[2], c1))) + strength * bias;
  }
  color = c;
  gl_Position = vec4(2.0 * pixel.x / size.x - 1.0, 1.0 - 2.0 * pixel.y / size.y, 0.0, 1.0);
}
