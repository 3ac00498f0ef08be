#version 300 es
// One triangle that covers the screen: corners (-1,-1), (3,-1), (-1,3).
void main() {
  gl_Position = vec4(float(gl_VertexID == 1) * 4.0 - 1.0, float(gl_VertexID == 2) * 4.0 - 1.0, 0.0, 1.0);
}
