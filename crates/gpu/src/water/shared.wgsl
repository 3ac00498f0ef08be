// Shared by all kernels of the water. The parameters lie flat, as in the processor's model. With n anchors
// they are 3 n centres, n log widths, then per anchor 144 coefficients `[quantity][band][channel]`. Without
// anchors they are the 144 coefficients alone.

struct Water {
    width: u32,
    height: u32,
    pixels: u32,
    // Number of active bands: 1, 4, 9 or 16.
    bands: u32,
    // Number of anchors; 0 for one set of coefficients that holds everywhere.
    anchors: u32,
    shared_by: u32,
    // Number of workgroups of the backward sums.
    groups: u32,
    parameters: u32,
    // Rows of the rotation from the camera into the world; w holds the camera's position, clamped.
    to_world_x: vec4<f32>,
    to_world_y: vec4<f32>,
    to_world_z: vec4<f32>,
    // 1 / focal length in x and in y, then the principal point.
    lens: vec4<f32>,
    // Adam: step size of constants, step size of directions and anchors, 1 / √(second bias correction); one
    // spare.
    adam: vec4<f32>,
}

const COEFFICIENTS: u32 = 144u;
// First planes of the sections of `maps`: the colour, then k of attenuation and of backscatter.
const ATTENUATION: u32 = 3u;
const BACKSCATTER: u32 = 6u;

struct Ray {
    direction: vec3<f32>,
    // Length of (x, y, 1).
    length: f32,
}

fn ray_of(pixel: u32) -> Ray {
    let u = f32(pixel % water.width) + 0.5;
    let v = f32(pixel / water.width) + 0.5;
    let x = (u - water.lens.z) * water.lens.x;
    let y = (v - water.lens.w) * water.lens.y;
    let length = sqrt(x * x + y * y + 1.0);
    let seen = vec3<f32>(x, y, 1.0);
    let world = vec3<f32>(
        dot(water.to_world_x.xyz, seen),
        dot(water.to_world_y.xyz, seen),
        dot(water.to_world_z.xyz, seen),
    );
    return Ray(world / length, length);
}

// The values of the harmonics at a direction, four bands to a row. They are no array, so that they stay in
// registers.
struct Basis {
    row0: vec4<f32>,
    row1: vec4<f32>,
    row2: vec4<f32>,
    row3: vec4<f32>,
}

fn basis_of(d: vec3<f32>) -> Basis {
    let x = d.x;
    let y = d.y;
    let z = d.z;
    let xx = x * x;
    let yy = y * y;
    let zz = z * z;
    return Basis(
        vec4<f32>(0.2820948, -0.4886025 * y, 0.4886025 * z, -0.4886025 * x),
        vec4<f32>(
            1.0925484 * (x * y),
            -1.0925484 * (y * z),
            0.31539157 * (2.0 * zz - xx - yy),
            -1.0925484 * (x * z),
        ),
        vec4<f32>(
            0.5462742 * (xx - yy),
            -0.5900436 * y * (3.0 * xx - yy),
            2.8906114 * (x * y) * z,
            -0.4570458 * y * (4.0 * zz - xx - yy),
        ),
        vec4<f32>(
            0.37317634 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy),
            -0.4570458 * x * (4.0 * zz - xx - yy),
            1.4453057 * z * (xx - yy),
            -0.5900436 * x * (xx - 3.0 * yy),
        ),
    );
}
