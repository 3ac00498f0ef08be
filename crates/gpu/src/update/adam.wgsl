// One step of Adam on one number. `bit` says which kind of number it is: it is set in `bad` if the number is
// not finite afterwards.
var<private> bad: u32;

fn adam(p: f32, g: f32, m: ptr<function, f32>, v: ptr<function, f32>, rate: f32, bit: u32) -> f32 {
    let b = constants.adam;
    *m = b.x * *m + (1.0f - b.x) * g;
    *v = b.y * *v + (1.0f - b.y) * g * g;
    let moved = p - rate * *m / (sqrt(*v) * b.z + b.w);
    if (is_bad(moved)) { bad |= bit; }
    return moved;
}
