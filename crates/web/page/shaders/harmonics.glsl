// Real spherical harmonics of a unit direction up to degree 3, in the order and with the signs of 3D Gaussian
// splatting.
void harmonics(vec3 d, out float y[16]) {
  float x = d.x, v = d.y, z = d.z, xx = x * x, vv = v * v, zz = z * z;
  y[0] = 0.2820948;
  y[1] = -0.4886025 * v;
  y[2] = 0.4886025 * z;
  y[3] = -0.4886025 * x;
  y[4] = 1.0925484 * x * v;
  y[5] = -1.0925484 * v * z;
  y[6] = 0.31539157 * (2.0 * zz - xx - vv);
  y[7] = -1.0925484 * x * z;
  y[8] = 0.5462742 * (xx - vv);
  y[9] = -0.5900436 * v * (3.0 * xx - vv);
  y[10] = 2.8906114 * x * v * z;
  y[11] = -0.4570458 * v * (4.0 * zz - xx - vv);
  y[12] = 0.37317634 * z * (2.0 * zz - 3.0 * xx - 3.0 * vv);
  y[13] = -0.4570458 * x * (4.0 * zz - xx - vv);
  y[14] = 1.4453057 * z * (xx - vv);
  y[15] = -0.5900436 * x * (xx - 3.0 * vv);
}
