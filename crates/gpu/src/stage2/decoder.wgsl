// The decoder: hidden units over a code of RANK entries, and six outputs.
fn logistic(x: f32) -> f32 { return 1.0f / (1.0f + exp(-clamp(x, -80.0f, 80.0f))); }

// Value of a hidden unit before its activation function.
fn activation(unit: u32, z: ptr<function, array<f32, RANK>>) -> f32 {
    var pre = state[field.hidden_bias + unit];
    let at = field.hidden_weight + unit * RANK;
    for (var r = 0u; r < RANK; r++) { pre = fma((*z)[r], state[at + r], pre); }
    return pre;
}

// Weights of a hidden unit in the three log-gains, and in the three biases.
fn gain_weights(unit: u32) -> vec3<f32> {
    let at = field.output_weight + unit;
    return vec3<f32>(state[at], state[at + field.width], state[at + 2u * field.width]);
}
fn bias_weights(unit: u32) -> vec3<f32> {
    let at = field.output_weight + 3u * field.width + unit;
    return vec3<f32>(state[at], state[at + field.width], state[at + 2u * field.width]);
}
