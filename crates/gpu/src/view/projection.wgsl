// Shared by the forward and the backward pass of the projection.
//
// The axes a, b of a Gaussian on the screen have the cross product c = a x b = (Rq)^T n times jx jy. Here n =
// r2 + sx r0 + sy r1 is the direction to the Gaussian. The product has no difference of nearly equal numbers,
// however thin the Gaussian is. The determinant of its covariance is a sum of squares of c. So are the terms
// of the inverse that the backward pass needs. So f32 suffices where the textbook's form needs f64.
const NEAR: f32 = 0.01f;
const FAR: f32 = 10000.0f;
const BLUR: f32 = 0.3f;
const LOG2_255: f32 = 7.9943533f;
const LOG2_E: f32 = 1.4426950f;
const LN_2: f32 = 0.69314718f;

struct Screen {
    x: vec3<f32>,
    slope: vec2<f32>,
    free: vec2<bool>,
    unit: vec4<f32>,
    norm: f32,
    // Squared standard deviations.
    variance: vec3<f32>,
    // Columns of the Gaussian's rotation.
    turn: mat3x3<f32>,
    jr0: vec3<f32>,
    jr1: vec3<f32>,
    a: vec3<f32>,
    b: vec3<f32>,
    c: vec3<f32>,
}

// Position in the camera's frame. The camera's centre is subtracted first, which keeps the digits of near
// points.
fn camera_frame(mean: vec3<f32>) -> vec3<f32> {
    let d = (mean - constants.center.xyz) - constants.center_rest.xyz;
    return vec3<f32>(
        dot(constants.rotation[0].xyz, d),
        dot(constants.rotation[1].xyz, d),
        dot(constants.rotation[2].xyz, d),
    );
}

fn rotation_of(q: vec4<f32>) -> mat3x3<f32> {
    let w = q.x;
    let x = q.y;
    let y = q.z;
    let z = q.w;
    return mat3x3<f32>(
        vec3<f32>(1.0f - 2.0f * (y * y + z * z), 2.0f * (x * y + w * z), 2.0f * (x * z - w * y)),
        vec3<f32>(2.0f * (x * y - w * z), 1.0f - 2.0f * (x * x + z * z), 2.0f * (y * z + w * x)),
        vec3<f32>(2.0f * (x * z + w * y), 2.0f * (y * z - w * x), 1.0f - 2.0f * (x * x + y * y)),
    );
}

fn screen_of(x: vec3<f32>, log_scale: vec3<f32>, q: vec4<f32>) -> Screen {
    var s: Screen;
    s.x = x;
    let raw = vec2<f32>(x.x / x.z, x.y / x.z);
    let low = vec2<f32>(constants.limits.x, constants.limits.z);
    let high = vec2<f32>(constants.limits.y, constants.limits.w);
    s.slope = min(max(raw, low), high);
    s.free = (raw > low) & (raw < high);
    s.norm = sqrt(q.x * q.x + q.y * q.y + q.z * q.z + q.w * q.w);
    s.unit = q / s.norm;
    s.turn = rotation_of(s.unit);
    s.variance = exp2((2.0f * LOG2_E) * log_scale);
    let r0 = constants.rotation[0].xyz;
    let r1 = constants.rotation[1].xyz;
    let r2 = constants.rotation[2].xyz;
    let j = constants.lens.xy / x.z;
    s.jr0 = j.x * (r0 - s.slope.x * r2);
    s.jr1 = j.y * (r1 - s.slope.y * r2);
    s.a = s.jr0 * s.turn;
    s.b = s.jr1 * s.turn;
    s.c = (j.x * j.y) * ((r2 + s.slope.x * r0 + s.slope.y * r1) * s.turn);
    return s;
}
