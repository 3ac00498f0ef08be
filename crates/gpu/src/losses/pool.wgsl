// Means of 2 × 2 pixels of both images, for the next level. An odd side is padded with a black pixel at both
// ends; only the first of these is read. The images are stored less one, so black is −1.

// Position of a fine pixel. An odd side is shifted by one for the padding.
fn place(column: u32, row: u32, dx: u32, dy: u32) -> vec2<u32> {
    // In the padding this wraps to a huge number.
    return vec2<u32>(2u * column + dx - size.fine_width % 2u, 2u * row + dy - size.fine_height % 2u);
}

fn inside(at: vec2<u32>) -> bool {
    return at.x < size.fine_width && at.y < size.fine_height;
}

@compute @workgroup_size(WG)
fn main(
    @builtin(workgroup_id) wid: vec3<u32>,
    @builtin(num_workgroups) nwg: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let cell = group_of(wid, nwg) * WG + lane;
    if (cell >= 3u * size.width * size.height) {
        return;
    }
    let column = cell % size.width;
    let row = (cell / size.width) % size.height;
    let channel = cell / (size.width * size.height);
    let start = channel * size.fine_width * size.fine_height;
    var x = array<f32, 4>(-1.0, -1.0, -1.0, -1.0);
    var y = array<f32, 4>(-1.0, -1.0, -1.0, -1.0);
    for (var k = 0u; k < 4u; k = k + 1u) {
        let at = place(column, row, k & 1u, k >> 1u);
        if (inside(at)) {
            let here = start + at.y * size.fine_width + at.x;
            x[k] = fine[here];
            y[k] = fine_target[here];
        }
    }
    coarse[cell] = ((x[0] + x[1]) + (x[2] + x[3])) * 0.25;
    coarse_target[cell] = ((y[0] + y[1]) + (y[2] + y[3])) * 0.25;
}
