// One workgroup: computes the mean that is subtracted from every Gaussian's outputs, the water's guide table,
// and the two transport ratios.
@compute @workgroup_size(WG)
fn main(@builtin(local_invocation_index) lid: u32) {
    let groups = (field.centred + 63u) / 64u;
    var own = array<vec4<f32>, 2>();
    for (var group = lid; group < groups; group += WG) {
        own[0] += partial[2u * group];
        own[1] += partial[2u * group + 1u];
    }
    let gains = sum_of_rows(own[0], lid);
    let biases = sum_of_rows(own[1], lid);
    if (lid >= OUTPUTS) { return; }
    var sum = gains[lid % 3u];
    if (lid >= 3u) { sum = biases[lid % 3u]; }
    grade[lid] = sum / f32(max(field.centred, 1u));
    if (field.lookups == field.listed) { return; }
    var mean = 0.0f;
    for (var row = 0u; row < TABLE; row++) { mean += raw[OUTPUTS * (field.listed + row) + lid]; }
    mean /= f32(TABLE);
    for (var row = 0u; row < TABLE; row++) {
        let centred = raw[OUTPUTS * (field.listed + row) + lid] - mean;
        grade[GRADE_TABLE + OUTPUTS * row + lid] = select(centred, exp(centred), lid < 3u);
    }
    if (lid < 2u) { grade[GRADE_RATIOS + lid] = exp(LOG_RATIO * squash(state[field.transport + lid])); }
}
