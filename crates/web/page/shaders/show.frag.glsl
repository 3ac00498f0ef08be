#version 300 es
// Draws the summed picture to the screen. Colours are clamped. Depth is the mean z = sum w z / sum w: near is
// bright, far is dark blue, unknown is black. It is scaled in inverse depth, as the eye judges distance.
precision highp float;
uniform sampler2D picture;
uniform bool depthOnly;
uniform vec3 gains;             // gains of the white balance
uniform vec2 range;             // nearest and farthest depth shown
out vec4 outColor;

// From dark blue over teal and sand to pale yellow; lightness rises evenly.
vec3 ramp(float t) {
  const vec3 stops[5] = vec3[5](vec3(0.03, 0.05, 0.22), vec3(0.06, 0.28, 0.47), vec3(0.13, 0.55, 0.55), vec3(0.62, 0.76, 0.45), vec3(0.99, 0.95, 0.70));
  float at = clamp(t, 0.0, 1.0) * 4.0;
  int k = int(min(at, 3.0));
  return mix(stops[k], stops[k + 1], at - float(k));
}

void main() {
  vec4 sum = texelFetch(picture, ivec2(gl_FragCoord.xy), 0);
  if (!depthOnly) { outColor = vec4(clamp(gains * sum.rgb, 0.0, 1.0), 1.0); return; }
  float z = sum.r / max(sum.a, 1e-6);
  vec3 c = z > 0.0 ? ramp((1.0 / z - 1.0 / range.y) / max(1.0 / range.x - 1.0 / range.y, 1e-9)) : vec3(0.0);
  outColor = vec4(c, 1.0);
}
