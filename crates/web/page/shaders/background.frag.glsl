#version 300 es
// Open water, where nothing ends the ray: its colour c_m times the amount of water that is left. Alpha starts
// at 0 and adds up the weights.
precision highp float;
uniform sampler2D waterColor;
uniform float amount;
out vec4 outColor;
void main() { outColor = vec4(amount * texelFetch(waterColor, ivec2(gl_FragCoord.xy), 0).rgb, 0.0); }
