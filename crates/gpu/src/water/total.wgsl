// The workgroups' sums added up, one coefficient a workgroup.

const LANES: u32 = 128u;

var<workgroup> cells: array<f32, 128>;

@compute @workgroup_size(WG)
fn main(@builtin(workgroup_id) wid: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    var own = 0.0;
    for (var at = lane; at < water.groups; at = at + LANES) {
        own = own + partial[wid.x * water.groups + at];
    }
    cells[lane] = own;
    workgroupBarrier();
    for (var reach = 64u; reach > 0u; reach = reach >> 1u) {
        if (lane < reach) {
            cells[lane] = cells[lane] + cells[lane + reach];
        }
        workgroupBarrier();
    }
    if (lane == 0u) {
        by_mixed[wid.x] = cells[0];
    }
}
