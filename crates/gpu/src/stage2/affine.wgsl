// Applies the scene's affine map to a colour: (I + A) c + b.
fn graded_of(c: vec3<f32>) -> vec3<f32> {
    var graded = vec3<f32>();
    for (var o = 0u; o < 3u; o++) {
        let row = field.affine + 4u * o;
        graded[o] = c[o] + fma(state[row], c.x, fma(state[row + 1u], c.y, fma(state[row + 2u], c.z, state[row + 3u])));
    }
    return graded;
}
