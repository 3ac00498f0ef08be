// Values of the real spherical harmonics at a unit direction, in the order and with the signs of the
// processor's.
fn harmonics(bands: u32, d: vec3<f32>) -> array<f32, 16> {
    var b = array<f32, 16>();
    let x = d.x;
    let y = d.y;
    let z = d.z;
    b[0] = 0.2820948f;
    if (bands > 1u) {
        b[1] = -0.4886025f * y;
        b[2] = 0.4886025f * z;
        b[3] = -0.4886025f * x;
    }
    if (bands > 4u) {
        let xx = x * x;
        let yy = y * y;
        let zz = z * z;
        b[4] = 1.0925484f * (x * y);
        b[5] = -1.0925484f * (y * z);
        b[6] = 0.31539157f * (2.0f * zz - xx - yy);
        b[7] = -1.0925484f * (x * z);
        b[8] = 0.5462742f * (xx - yy);
        if (bands > 9u) {
            b[9] = -0.5900436f * y * (3.0f * xx - yy);
            b[10] = 2.8906114f * (x * y) * z;
            b[11] = -0.4570458f * y * (4.0f * zz - xx - yy);
            b[12] = 0.37317634f * z * (2.0f * zz - 3.0f * xx - 3.0f * yy);
            b[13] = -0.4570458f * x * (4.0f * zz - xx - yy);
            b[14] = 1.4453057f * z * (xx - yy);
            b[15] = -0.5900436f * x * (xx - 3.0f * yy);
        }
    }
    return b;
}

// The unit direction from the camera to a Gaussian; (0, 0, 1) if they coincide.
fn direction_to(mean: vec3<f32>) -> vec3<f32> {
    let d = mean - constants.center.xyz;
    let norm = sqrt(d.x * d.x + d.y * d.y + d.z * d.z);
    if (norm > 0.0f) { return d / norm; }
    return vec3<f32>(0.0f, 0.0f, 1.0f);
}
