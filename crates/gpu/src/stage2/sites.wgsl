// The position of a lookup, in two rows of four words. The first row has the bits of the fractions on x, y,
// z, then the three nodes, eight bits each. The second row has the bits of the signed logs of its colour,
// then 0; or the bits of a fixed guide coordinate, and 1 in the last word.
fn is_fixed(i: u32) -> bool { return sites[2u * i + 1u].w != 0u; }

fn gamma_of(i: u32) -> f32 {
    let words = sites[2u * i + 1u];
    if (words.w != 0u) { return bitcast<f32>(words.x); }
    return guide_of(bitcast<vec3<f32>>(words.xyz));
}

fn places_of(i: u32, gamma: f32) -> array<Place, 4> {
    let words = sites[2u * i];
    let t = bitcast<vec3<f32>>(words.xyz);
    return array<Place, 4>(
        Place(words.w & 255u, t.x),
        Place((words.w >> 8u) & 255u, t.y),
        Place((words.w >> 16u) & 255u, t.z),
        locate(gamma, field.resolution),
    );
}

// Entry `r` of the factor of an axis, interpolated between the two nodes of a place.
fn factor(axis: u32, place: Place, r: u32) -> f32 {
    let at = (axis * field.resolution + place.node) * RANK + r;
    let low = state[at];
    return low + place.t * (state[at + RANK] - low);
}
