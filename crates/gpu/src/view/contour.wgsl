// The exact tiles of a Gaussian, one row of tiles after another: the tiles with a pixel centre inside the box
// of its 1/255 contour along that row.
const TILE: u32 = 16u;

struct Contour {
    x: f32,
    y: f32,
    shear: f32,
    steepness: f32,
    steepness_y: f32,
    level: f32,
    reach_y: f32,
}

// Centres of the first and last pixel of a tile along an axis; tiles of columns come first, then those of rows.
fn ends_of(t: u32) -> vec2<f32> { return vec2<f32>(axes[t * TILE], axes[t * TILE + TILE - 1u]); }
fn down(row: u32) -> vec2<f32> { return ends_of(constants.size.z + row); }

// Half-open range, among the `n` tiles from `start` on, of those with a pixel centre in [low, high]. Centres
// lie at equal distances, except in a lattice of chosen pixels. So a search begins where the tile would be at
// equal distances, and mostly ends there.
fn tiles_meeting(start: u32, n: u32, low: f32, high: f32) -> vec2<u32> {
    let ends = ends_of(start);
    let pitch = max((ends_of(start + n - 1u).x - ends.x) / f32(max(n, 2u) - 1u), 1e-6f);
    var a = min(u32(ceil(clamp((low - ends.y) / pitch, 0.0f, 65535.0f))), n);
    while (a > 0u && ends_of(start + a - 1u).y >= low) { a--; }
    while (a < n && ends_of(start + a).y < low) { a++; }
    var b = clamp(u32(floor(clamp((high - ends.x) / pitch, -1.0f, 65535.0f)) + 1.0f), a, n);
    while (b > a && ends_of(start + b - 1u).x > high) { b--; }
    while (b < n && ends_of(start + b).x <= high) { b++; }
    return vec2<u32>(a, b);
}

fn columns_meeting(low: f32, high: f32) -> vec2<u32> {
    return tiles_meeting(0u, constants.size.z, low, high);
}

fn rows_meeting(low: f32, high: f32) -> vec2<u32> {
    return tiles_meeting(constants.size.z, constants.size.w, low, high);
}

fn half_width(s: Contour, dy: f32) -> f32 {
    return sqrt(max(s.level - s.steepness_y * dy * dy, 0.0f) / s.steepness);
}

fn within(dy: f32, low: f32, high: f32) -> f32 {
    if ((bitcast<u32>(dy) & 0x7fffffffu) > 0x7f800000u) { return low; }
    return min(max(dy, low), high);
}

fn margin(x: f32) -> f32 { return 1e-3f + 1e-5f * abs(x); }

// The tiles of one row of tiles, as a half-open range; empty if its first number is not below its second.
fn row_span(s: Contour, row: u32) -> vec2<u32> {
    let rows = down(row);
    let low = max(rows.x - s.y, -s.reach_y);
    let high = min(rows.y - s.y, s.reach_y);
    if (!(low <= high)) { return vec2<u32>(0u, 0u); }
    let a = s.steepness;
    let d = s.steepness_y;
    let tangent = s.shear * sqrt(s.level * a / (d * (d + a * s.shear * s.shear)));
    let right = within(-tangent, low, high);
    let left = within(tangent, low, high);
    let x0 = -s.shear * left - half_width(s, left);
    let x1 = -s.shear * right + half_width(s, right);
    return columns_meeting(s.x + (x0 - margin(x0)), s.x + (x1 + margin(x1)));
}
