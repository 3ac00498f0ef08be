// The guide coordinate of a colour, computed from its signed logs.
fn guide_of(h: vec3<f32>) -> f32 {
    let g = field.guide;
    return squash(fma(state[g], h.x, fma(state[g + 1u], h.y, fma(state[g + 2u], h.z, state[g + 3u]))));
}
