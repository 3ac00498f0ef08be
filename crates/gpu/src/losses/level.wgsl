// Shared by the forward and the backward pass of a level: the window, and the tile that a workgroup blurs.
// Its 16 × 16 positions read 26 × 26 cells.

const MARGIN: u32 = 10u;
const SIDE: u32 = 26u;

var<workgroup> tile_a: array<f32, 676>;
var<workgroup> tile_b: array<f32, 676>;
// Blurred along rows: 26 rows × 16 columns.
var<workgroup> rows: array<vec4<f32>, 416>;


// The tile of 16 × 16 positions and the channel that a workgroup owns: (tile column, tile row, channel).
// `across` is the number of tiles per row, `all` the number of tiles per channel.
fn tile_of(group: u32, across: u32, all: u32) -> vec3<u32> {
    let tile = group % all;
    return vec3<u32>(tile % across, tile / across, group / all);
}
