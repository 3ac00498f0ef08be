// Values of the water's table at a guide coordinate: gain and bias, and how much each rises from the lower
// row to the next.
struct Graded {
    place: Place,
    gain: vec3<f32>,
    bias: vec3<f32>,
    gain_rise: vec3<f32>,
    bias_rise: vec3<f32>,
}

fn table_row(row: u32, at: u32) -> vec3<f32> {
    let first = GRADE_TABLE + OUTPUTS * row + at;
    return vec3<f32>(grade[first], grade[first + 1u], grade[first + 2u]);
}

fn table_at(gamma: f32) -> Graded {
    let place = locate(gamma, TABLE);
    let gain = table_row(place.node, 0u);
    let bias = table_row(place.node, 3u);
    let gain_rise = table_row(place.node + 1u, 0u) - gain;
    let bias_rise = table_row(place.node + 1u, 3u) - bias;
    return Graded(place, gain + place.t * gain_rise, bias + place.t * bias_rise, gain_rise, bias_rise);
}
