// Forward pass of one level of the structure measure. Blurs the moments with the 11-tap window over the valid
// region. Computes the sum of the level's values, and the gradients with respect to the mean, the mean square
// and the mean product.

const C1: f32 = 0.01 * 0.01;
const C2: f32 = 0.03 * 0.03;

// The two images, the sum of their squares, and their product.
fn moments(at: u32) -> vec4<f32> {
    let a = tile_a[at];
    let b = tile_b[at];
    return vec4<f32>(a, b, a * a + b * b, a * b);
}

// The window along a row of the tile. The loop over its taps is written out, so that they are constants.
fn along_row(start: u32) -> vec4<f32> {
    var sum = TAP0 * moments(start);
    sum = sum + TAP1 * moments(start + 1u);
    sum = sum + TAP2 * moments(start + 2u);
    sum = sum + TAP3 * moments(start + 3u);
    sum = sum + TAP4 * moments(start + 4u);
    sum = sum + TAP5 * moments(start + 5u);
    sum = sum + TAP4 * moments(start + 6u);
    sum = sum + TAP3 * moments(start + 7u);
    sum = sum + TAP2 * moments(start + 8u);
    sum = sum + TAP1 * moments(start + 9u);
    sum = sum + TAP0 * moments(start + 10u);
    return sum;
}

// The window along a column of the blurred rows.
fn along_column(start: u32) -> vec4<f32> {
    var sum = TAP0 * rows[start];
    sum = sum + TAP1 * rows[start + 16u];
    sum = sum + TAP2 * rows[start + 32u];
    sum = sum + TAP3 * rows[start + 48u];
    sum = sum + TAP4 * rows[start + 64u];
    sum = sum + TAP5 * rows[start + 80u];
    sum = sum + TAP4 * rows[start + 96u];
    sum = sum + TAP3 * rows[start + 112u];
    sum = sum + TAP2 * rows[start + 128u];
    sum = sum + TAP1 * rows[start + 144u];
    sum = sum + TAP0 * rows[start + 160u];
    return sum;
}

@compute @workgroup_size(WG)
fn main(
    @builtin(workgroup_id) wid: vec3<u32>,
    @builtin(num_workgroups) nwg: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let across = (level.width - MARGIN + 15u) / 16u;
    let tiles = view.level_groups[level.index];
    let tile = tile_of(group_of(wid, nwg), across, tiles);
    if (tile.z >= 3u) {
        return;
    }
    let local = vec2<u32>(lane % 16u, lane / 16u);
    let columns = level.width - MARGIN;
    let lines = level.height - MARGIN;
    let plane = tile.z * level.width * level.height;
    let corner = tile.xy * 16u;
    for (var cell = lane; cell < SIDE * SIDE; cell = cell + 256u) {
        let at = corner + vec2<u32>(cell % SIDE, cell / SIDE);
        var a = 0.0;
        var b = 0.0;
        if (at.x < level.width && at.y < level.height) {
            let start = plane + at.y * level.width + at.x;
            a = x_plane[start];
            b = y_plane[start];
        }
        tile_a[cell] = a;
        tile_b[cell] = b;
    }
    workgroupBarrier();
    for (var cell = lane; cell < SIDE * 16u; cell = cell + 256u) {
        let start = (cell / 16u) * SIDE + cell % 16u;
        rows[cell] = along_row(start);
    }
    workgroupBarrier();
    let m = along_column(local.y * 16u + local.x);
    let spread = max(m.z - m.x * m.x - m.y * m.y, 0.0);
    let covariance = clamp(2.0 * (m.w - m.x * m.y), -spread, spread);
    let inverse = 1.0 / (spread + C2);
    let cs = (covariance + C2) * inverse;
    var value = cs;
    var d_mean = (m.x * cs - m.y) * inverse * 2.0;
    var d_square = -cs * inverse;
    var d_product = inverse * 2.0;
    if (level.last != 0u) {
        let full_x = m.x + 1.0;
        let full_y = m.y + 1.0;
        let below = 1.0 / (full_x * full_x + full_y * full_y + C1);
        let luminance = (full_x * full_y * 2.0 + C1) * below;
        value = luminance * cs;
        d_mean = d_mean * luminance + cs * (full_y - full_x * luminance) * below * 2.0;
        d_square = d_square * luminance;
        d_product = d_product * luminance;
    }
    let at = corner + local;
    let valid = at.x < columns && at.y < lines;
    if (valid) {
        let to = tile.z * columns * lines + at.y * columns + at.x;
        by_mean[to] = d_mean;
        by_square[to] = d_square;
        by_product[to] = d_product;
    }
    let total = sum_of_group(select(0.0, value, valid), lane);
    if (lane == 0u) {
        sums[view.level_first[level.index] + tile.z * tiles + tile.y * across + tile.x] = total;
    }
}
