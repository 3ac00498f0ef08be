// The colours of the Gaussians of a chunk. Each thread computes the harmonics of one Gaussian. Then the
// workgroup moves all colours of its Gaussians, row by row in the order of memory, so that its threads read
// neighbouring rows. A row has four of a Gaussian's 48 numbers, which lie band by band in groups of three
// channels.
const ROWS_OF_ONE: u32 = 12u;
// Numbers between two Gaussians in workgroup memory: one more than there are, for different banks.
const STRIDE: u32 = 17u;

var<workgroup> basis: array<f32, WG * STRIDE>;
var<workgroup> pull: array<f32, WG * 3u>;

@compute @workgroup_size(WG)
fn main(
    @builtin(workgroup_id) wid: vec3<u32>,
    @builtin(num_workgroups) nwg: vec3<u32>,
    @builtin(local_invocation_index) lid: u32,
) {
    let first = group_of(wid, nwg) * WG;
    let end = min(chunk.y, constants.counts.x - chunk.x);
    let bands = constants.counts.y;
    let going = atomicLoad(&counts[STOP]) == 0u;
    bad = 0u;
    if (first + lid < end) {
        let at = 6u * (chunk.x + first + lid);
        let direction = vec3<f32>(color_pull[at + 3u], color_pull[at + 4u], color_pull[at + 5u]);
        var y = harmonics(bands, direction);
        for (var k = 0u; k < 16u; k++) { basis[STRIDE * lid + k] = y[k]; }
        for (var c = 0u; c < 3u; c++) { pull[3u * lid + c] = color_pull[at + c]; }
    }
    workgroupBarrier();
    if (going) {
        for (var row = lid; row < ROWS_OF_ONE * WG; row += WG) {
            let own = row / ROWS_OF_ONE;
            let number = 4u * (row % ROWS_OF_ONE);
            if (first + own < end && number < 3u * bands) {
                let at = ROWS_OF_ONE * first + row;
                var values = colors[at];
                var means = colors_first[at];
                var squares = colors_second[at];
                for (var j = 0u; j < 4u; j++) {
                    let k = (number + j) / 3u;
                    if (k < bands) {
                        let g = basis[STRIDE * own + k] * pull[3u * own + (number + j) % 3u];
                        let rate = select(constants.color_rates.y, constants.color_rates.x, k == 0u);
                        var m = means[j];
                        var v = squares[j];
                        values[j] = adam(values[j], g, &m, &v, rate, 16u);
                        means[j] = m;
                        squares[j] = v;
                    }
                }
                colors[at] = values;
                colors_first[at] = means;
                colors_second[at] = squares;
            }
        }
        if (bad != 0u) { atomicOr(&counts[BAD], bad); }
    }
}
