#version 300 es
// The water along each pixel's ray: its colour at infinity c_m, and the coefficients of backscatter and
// attenuation (1 / scene unit). They are computed once per pixel into three targets.
//
//   kind 1 (harmonics):  raw_q = sum_b Y_b(w) A_qb,   c_m = max(raw + 0.5, 0),   beta = softplus(raw)
//   kind 2 (baked):      the nine numbers are read from a cube of directions, which the exporter filled
//
// An enhanced water has its colour graded by a table over the guide gamma(c_m). Its coefficients are scaled
// by two ratios, and by the share k of the water that the enhanced scene keeps:
//
//   h = sign(c) ln(1 + |c|),  gamma = tanh(w.h + b),
//   c+ = gain(gamma) (c + dA c + b_g) + bias(gamma),  beta+ = ratio k beta
//
// `amount` in [0, 1] is the share of the water that is left: it scales both coefficients.
precision highp float;
precision highp samplerCube;

uniform int kind;
uniform int bands;              // number of harmonics in use: 1, 4, 9 or 16
uniform vec3 harmonic[48];      // [c_m, backscatter, attenuation][band] RGB
uniform samplerCube cubeColor, cubeBackscatter, cubeAttenuation;
uniform vec4 lens;              // fx, fy, cx, cy in pixels; rows count downwards
uniform float height;
uniform vec3 right, down, forward;
uniform float amount;
uniform bool graded;
uniform vec4 guide;             // w_r, w_g, w_b, b
uniform vec4 affine[3];         // rows (dA | b_g), times the strength
uniform vec3 gains[16], biases[16];
uniform vec2 ratios;            // backscatter, attenuation
uniform vec3 kept;              // share of the stage-1 coefficients, RGB

layout(location = 0) out vec4 outColor;
layout(location = 1) out vec4 outBackscatter;
layout(location = 2) out vec4 outAttenuation;

//#include harmonics

vec3 sumOfBands(int first, float y[16]) {
  vec3 raw = vec3(0.0);
  for (int b = 0; b < 16; b++) { if (b < bands) raw += y[b] * harmonic[first + b]; }
  return raw;
}

vec3 softplus(vec3 x) { return max(x, 0.0) + log(1.0 + exp(-abs(x))); }

vec3 grade(vec3 c) {
  vec3 h = sign(c) * log(1.0 + abs(c));
  float gamma = tanh(dot(guide.xyz, h) + guide.w);
  float at = (gamma + 1.0) * 7.5;
  int row = int(min(at, 14.0));
  float t = at - float(row);
  vec3 gain = mix(gains[row], gains[row + 1], t), bias = mix(biases[row], biases[row + 1], t);
  vec4 c1 = vec4(c, 1.0);
  return gain * (c + vec3(dot(affine[0], c1), dot(affine[1], c1), dot(affine[2], c1))) + bias;
}

void main() {
  vec2 pixel = vec2(gl_FragCoord.x, height - gl_FragCoord.y);
  vec2 slope = (pixel - lens.zw) / lens.xy;
  vec3 ray = normalize(slope.x * right + slope.y * down + forward);
  vec3 color, backscatter, attenuation;
  if (kind == 1) {
    float y[16];
    harmonics(ray, y);
    color = max(sumOfBands(0, y) + 0.5, 0.0);
    backscatter = softplus(sumOfBands(16, y));
    attenuation = softplus(sumOfBands(32, y));
  } else {
    color = texture(cubeColor, ray).rgb;
    backscatter = texture(cubeBackscatter, ray).rgb;
    attenuation = texture(cubeAttenuation, ray).rgb;
  }
  if (graded) {
    color = grade(color);
    backscatter *= kept * ratios.x;
    attenuation *= kept * ratios.y;
  }
  outColor = vec4(color, 1.0);
  outBackscatter = vec4(amount * backscatter, 1.0);
  outAttenuation = vec4(amount * attenuation, 1.0);
}
