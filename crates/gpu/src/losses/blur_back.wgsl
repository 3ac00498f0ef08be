// Backward pass of one level of the structure measure. Blurs the gradients with respect to the moments back
// to the pixels, multiplies them with the level's factor, and adds the gradient from the coarser level.

// Tile of the third quantity.
var<workgroup> tile_c: array<f32, 676>;

fn slopes_at(at: u32) -> vec3<f32> {
    return vec3<f32>(tile_a[at], tile_b[at], tile_c[at]);
}

// The window along a row of the tile, from its last tap. The loop over its taps is written out, so that they
// are constants.
fn back_along_row(start: u32) -> vec3<f32> {
    var sum = TAP0 * slopes_at(start);
    sum = sum + TAP1 * slopes_at(start - 1u);
    sum = sum + TAP2 * slopes_at(start - 2u);
    sum = sum + TAP3 * slopes_at(start - 3u);
    sum = sum + TAP4 * slopes_at(start - 4u);
    sum = sum + TAP5 * slopes_at(start - 5u);
    sum = sum + TAP4 * slopes_at(start - 6u);
    sum = sum + TAP3 * slopes_at(start - 7u);
    sum = sum + TAP2 * slopes_at(start - 8u);
    sum = sum + TAP1 * slopes_at(start - 9u);
    sum = sum + TAP0 * slopes_at(start - 10u);
    return sum;
}

// The window along a column of the blurred rows.
fn back_along_column(start: u32) -> vec4<f32> {
    var sum = TAP0 * rows[start];
    sum = sum + TAP1 * rows[start - 16u];
    sum = sum + TAP2 * rows[start - 32u];
    sum = sum + TAP3 * rows[start - 48u];
    sum = sum + TAP4 * rows[start - 64u];
    sum = sum + TAP5 * rows[start - 80u];
    sum = sum + TAP4 * rows[start - 96u];
    sum = sum + TAP3 * rows[start - 112u];
    sum = sum + TAP2 * rows[start - 128u];
    sum = sum + TAP1 * rows[start - 144u];
    sum = sum + TAP0 * rows[start - 160u];
    return sum;
}

@compute @workgroup_size(WG)
fn main(
    @builtin(workgroup_id) wid: vec3<u32>,
    @builtin(num_workgroups) nwg: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let across = (level.width + 15u) / 16u;
    let tile = tile_of(group_of(wid, nwg), across, across * ((level.height + 15u) / 16u));
    if (tile.z >= 3u) {
        return;
    }
    let local = vec2<u32>(lane % 16u, lane / 16u);
    let columns = level.width - MARGIN;
    let lines = level.height - MARGIN;
    let plane = tile.z * columns * lines;
    let corner = tile.xy * 16u;
    for (var cell = lane; cell < SIDE * SIDE; cell = cell + 256u) {
        // Left of the first column or above the first row this wraps to a huge number.
        let at = corner + vec2<u32>(cell % SIDE, cell / SIDE) - vec2<u32>(MARGIN, MARGIN);
        var d = vec3<f32>(0.0);
        if (at.x < columns && at.y < lines) {
            let start = plane + at.y * columns + at.x;
            d = vec3<f32>(by_mean[start], by_square[start], by_product[start]);
        }
        tile_a[cell] = d.x;
        tile_b[cell] = d.y;
        tile_c[cell] = d.z;
    }
    workgroupBarrier();
    for (var cell = lane; cell < SIDE * 16u; cell = cell + 256u) {
        let start = (cell / 16u) * SIDE + cell % 16u + MARGIN;
        rows[cell] = vec4<f32>(back_along_row(start), 0.0);
    }
    workgroupBarrier();
    let at = corner + local;
    if (at.x >= level.width || at.y >= level.height) {
        return;
    }
    let d = back_along_column((local.y + MARGIN) * 16u + local.x);
    let cell = tile.z * level.width * level.height + at.y * level.width + at.x;
    let a = x_plane[cell];
    let b = y_plane[cell];
    var own = factors[3u * level.index + tile.z] * (2.0 * a * d.y + b * d.z + d.x);
    if (level.last == 0u) {
        let above = (at + vec2<u32>(level.width % 2u, level.height % 2u)) / 2u;
        let start = tile.z * level.coarse_width * level.coarse_height + above.y * level.coarse_width + above.x;
        own = own + 0.25 * coarse[start];
    }
    slope[cell] = own;
}
