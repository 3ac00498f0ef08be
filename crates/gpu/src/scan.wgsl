var<workgroup> scan_cells: array<u32, WG>;

// Returns the sum of `value` over the threads before this one, and the sum over the whole workgroup.
fn exclusive(lid: u32, value: u32) -> vec2<u32> {
    scan_cells[lid] = value;
    workgroupBarrier();
    for (var step = 1u; step < WG; step <<= 1u) {
        var before = 0u;
        if (lid >= step) { before = scan_cells[lid - step]; }
        workgroupBarrier();
        scan_cells[lid] += before;
        workgroupBarrier();
    }
    let sums = vec2<u32>(scan_cells[lid] - value, scan_cells[WG - 1u]);
    workgroupBarrier();
    return sums;
}
