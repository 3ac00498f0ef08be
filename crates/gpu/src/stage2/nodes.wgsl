// One thread per node of the four factor grids: the gradients with respect to its entries, summed over a
// block of lookups, 64 at a time. Each lookup lies between two nodes of an axis. Every thread reads all
// lookups and adds those at its own node, so there are no atomic additions.
const AT_ONCE: u32 = 64u;

var<workgroup> tile_slopes: array<f32, 4u * AT_ONCE * RANK>;
var<workgroup> tile_nodes: array<u32, 4u * AT_ONCE>;
var<workgroup> tile_fractions: array<f32, 4u * AT_ONCE>;

@compute @workgroup_size(WG)
fn main(
    @builtin(workgroup_id) wid: vec3<u32>,
    @builtin(num_workgroups) nwg: vec3<u32>,
    @builtin(local_invocation_index) lid: u32,
) {
    let group = group_of(wid, nwg);
    let block = group / field.node_groups;
    let own = (group % field.node_groups) * WG + lid;
    if (block >= field.blocks) { return; }
    let mine = own < 4u * field.resolution;
    let axis = own / field.resolution;
    let node = own % field.resolution;
    var sum: array<f32, RANK>;
    let end = min((block + 1u) * field.per_block, field.lookups);
    for (var first = block * field.per_block; first < end; first += AT_ONCE) {
        workgroupBarrier();
        let i = first + lid;
        if (i < end) {
            var places = places_of(i, gamma_of(i));
            for (var r = 0u; r < RANK; r++) {
                let d = by_codes[RANK * i + r];
                let x = factor(0u, places[0], r);
                let y = factor(1u, places[1], r);
                let w = factor(2u, places[2], r);
                let g = factor(3u, places[3], r);
                let xy = d * (x * y);
                let wg = d * (w * g);
                tile_slopes[lid * RANK + r] = y * wg;
                tile_slopes[(AT_ONCE + lid) * RANK + r] = x * wg;
                tile_slopes[(2u * AT_ONCE + lid) * RANK + r] = xy * g;
                tile_slopes[(3u * AT_ONCE + lid) * RANK + r] = xy * w;
            }
            for (var a = 0u; a < 4u; a++) {
                tile_nodes[a * AT_ONCE + lid] = places[a].node;
                tile_fractions[a * AT_ONCE + lid] = places[a].t;
            }
        }
        workgroupBarrier();
        let count = min(AT_ONCE, end - first);
        var here: array<f32, RANK>;
        for (var k = 0u; mine && k < count; k++) {
            let at = axis * AT_ONCE + k;
            let low = tile_nodes[at];
            var weight = tile_fractions[at];
            if (low == node) { weight = 1.0f - weight; } else if (low + 1u != node) { continue; }
            for (var r = 0u; r < RANK; r++) { here[r] = fma(weight, tile_slopes[at * RANK + r], here[r]); }
        }
        for (var r = 0u; r < RANK; r++) { sum[r] += here[r]; }
    }
    if (!mine) { return; }
    for (var r = 0u; r < RANK; r++) { partial[block * field.output_bias + own * RANK + r] = sum[r]; }
}
