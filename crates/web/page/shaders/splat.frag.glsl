#version 300 es
// The underwater compositor as ordinary alpha blending, back to front. The program's picture is
//
//   rgb = a (1 - sum w) c_m + sum w (c e^{-b_attn s} + c_m (1 - e^{-b_bs s})),    s = z |d(pixel)|
//
// where s is at most the greatest distance from which photographs saw the Gaussian: farther away it keeps
// their water.//
// So every Gaussian is drawn in the colour f = c e^{-b_attn s} + c_m (1 - e^{-b_bs s}) over the open water.
// The coefficients already contain the share a of the water that is left. Two weights choose the parts that
// are shown.
precision highp float;
in vec2 offset;
flat in vec3 color;
flat in float opacity, depth, farthest;
uniform sampler2D waterColor, waterBackscatter, waterAttenuation;
uniform bool watery;            // false: the water maps are not read
uniform bool depthOnly;
uniform float objects, veil;    // weights of the two parts
uniform vec4 lens;
uniform float height;
out vec4 outColor;

void main() {
  float alpha = min(0.999, opacity * exp(-0.5 * dot(offset, offset)));
  if (alpha < 1.0 / 255.0) discard;
  vec3 shown = color * objects;
  if (depthOnly) {
    shown = vec3(depth);
  } else if (watery) {
    ivec2 at = ivec2(gl_FragCoord.xy);
    vec2 slope = (vec2(gl_FragCoord.x, height - gl_FragCoord.y) - lens.zw) / lens.xy;
    float s = min(depth * sqrt(1.0 + dot(slope, slope)), farthest);
    vec3 backscatter = 1.0 - exp(-s * texelFetch(waterBackscatter, at, 0).rgb);
    vec3 attenuation = exp(-s * texelFetch(waterAttenuation, at, 0).rgb);
    shown = shown * attenuation + veil * texelFetch(waterColor, at, 0).rgb * backscatter;
  }
  outColor = vec4(alpha * shown, alpha);
}
