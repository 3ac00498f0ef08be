// Gradients with respect to the raw outputs of the table's rows, from those with respect to the table. Gains
// are exponentials, and the mean of the rows is subtracted.
@compute @workgroup_size(WG)
fn main(@builtin(local_invocation_index) lid: u32) {
    if (lid >= OUTPUTS) { return; }
    var d = array<f32, 16>();
    var mean = 0.0f;
    for (var row = 0u; row < TABLE; row++) {
        d[row] = totals[OF_WATER + OUTPUTS * row + lid];
        if (lid < 3u) { d[row] *= grade[GRADE_TABLE + OUTPUTS * row + lid]; }
        mean += d[row];
    }
    mean /= f32(TABLE);
    for (var row = 0u; row < TABLE; row++) { slopes[OUTPUTS * (field.listed + row) + lid] = d[row] - mean; }
}
