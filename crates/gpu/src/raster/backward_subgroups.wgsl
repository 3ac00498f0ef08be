// One workgroup per tile; each thread has one, two or four neighbouring pixels. The threads that run in step
// are a team (a subgroup). Pixels are numbered along a Z-curve, so the pixels of a team form a rectangle of
// the tile.
//
// Gaussians are taken in rounds. In a round each team skips the Gaussians that miss its rectangle, and walks
// over the others from the farthest to the nearest. The threads of a team add up their gradients by
// exchanging halves of what they hold, in an order that this text fixes. The teams' sums are then added in
// the order of the teams.
//
// The kernel is compiled for one width of a subgroup. If it runs with another one, it writes NaN, which the
// check at the start notices.
const TEAMS: u32 = WG / WIDTH;
const ROUND: u32 = HALVES * WIDTH;
const WORDS: u32 = (WIDTH + 31u) / 32u;

var<workgroup> near: array<vec4<f32>, ROUND>;
var<workgroup> far: array<vec4<f32>, ROUND>;
var<workgroup> tint: array<vec4<f32>, ROUND>;
// The teams' sums: twelve numbers of each Gaussian of the round, team after team.
var<workgroup> parts: array<f32, 12u * TEAMS * ROUND>;
// Bit masks by team and by part of the round: the Gaussians that have a gradient there.
var<workgroup> hits: array<u32, HALVES * TEAMS * WORDS>;
var<workgroup> last: atomic<u32>;
var<workgroup> last_entry: u32;

struct Pixel {
    x: f32,
    y: f32,
    end: u32,
    left: f32,
    behind: f32,
    by_depth: f32,
    by_weight: f32,
    pull: vec3<f32>,
    veiled_pull: vec3<f32>,
    ka: vec3<f32>,
    kb: vec3<f32>,
}

struct Record { r0: vec4<f32>, r1: vec4<f32>, r2: vec4<f32> }

// Takes every second bit of eight, beginning with the lowest.
fn compact(bits: u32) -> u32 {
    return (bits & 1u) | ((bits >> 1u) & 2u) | ((bits >> 2u) & 4u) | ((bits >> 3u) & 8u);
}

// Position in the tile of a pixel on the curve: (column, row).
fn place_of(number: u32) -> vec2<u32> { return vec2<u32>(compact(number), compact(number >> 1u)); }

// The three values of a section of the water.
fn water_at(section: u32, pixel: u32) -> vec3<f32> {
    let plane = constants.size.x * constants.size.y;
    let first = section * plane + pixel;
    return vec3<f32>(water[first], water[first + plane], water[first + 2u * plane]);
}

fn pixel_at(tile: u32, at: vec2<u32>) -> Pixel {
    let column = (tile % constants.size.z) * TILE + at.x;
    let row = (tile / constants.size.z) * TILE + at.y;
    var p = Pixel();
    p.x = axes[column];
    p.y = axes[constants.size.z * TILE + row];
    p.left = 1.0f;
    if (column >= constants.size.x || row >= constants.size.y) { return p; }
    let plane = constants.size.x * constants.size.y;
    let pixel = row * constants.size.x + column;
    p.pull = vec3<f32>(image_pull[pixel], image_pull[plane + pixel], image_pull[2u * plane + pixel]);
    let sum = bitcast<f32>(kept[pixel]);
    p.by_depth = depth_pull[pixel] / max(sum, 1e-6f);
    if (sum > 1e-6f) { p.by_weight = -(p.by_depth * bitcast<f32>(kept[KEPT_DEPTH * plane + pixel])); }
    if (WATER) {
        p.veiled_pull = -(p.pull * water_at(0u, pixel));
        p.ka = water_at(K_ATTENUATION, pixel);
        p.kb = water_at(K_BACKSCATTER, pixel);
    }
    p.left = bitcast<f32>(kept[KEPT_TRANSMITTANCE * plane + pixel]);
    p.end = kept[KEPT_STOP * plane + pixel];
    return p;
}

// Moves a pixel past the Gaussian in place `k` of its list, and adds the gradient to the record. Returns true
// if there is a gradient.
fn pass_by(
    p: ptr<function, Pixel>,
    k: u32,
    a: vec4<f32>,
    b: vec4<f32>,
    color: vec3<f32>,
    s_gradient: f32,
    r: ptr<function, Record>,
) -> bool {
    let dy = (*p).y - a.y;
    let t = (*p).x - fma(a.z, -dy, a.x);
    let power = fma(t * a.w, -t, fma(b.x, -(dy * dy), b.y));
    let meets = power >= -LOG2_255 && (*p).end > k;
    // There is no early return: the threads of a subgroup must be together again at its next operation.
    if (meets) {
        let raw = exp2(power);
        let alpha = min(raw, ALPHA_MAX);
        let over = 1.0f / (1.0f - alpha);
        let transmittance = (*p).left * over;
        (*p).left = transmittance;
        let w = transmittance * alpha;
        let z = b.z;
        var v = fma((*p).by_depth, z, (*p).by_weight);
        var slope = 0.0f;
        var by_color = (*p).pull;
        if (WATER) {
            by_color = (*p).pull * exp2(-((*p).ka * z));
            let colored = by_color * color;
            let veiled = (*p).veiled_pull * exp2(-((*p).kb * z));
            v += colored.x + veiled.x;
            v += colored.y + veiled.y;
            v += colored.z + veiled.z;
            slope = -(dot((*p).ka, colored) + dot((*p).kb, veiled)) * s_gradient;
        } else {
            v += dot((*p).pull, color);
        }
        slope = fma((*p).by_depth, LOG2_E, slope);
        let wv = w * v;
        var pulled = fma(alpha * over, (*p).behind, wv);
        (*p).behind -= wv;
        if (!(raw <= ALPHA_MAX)) { pulled = 0.0f; }
        let pt = pulled * t;
        let py = pulled * dy;
        let across = fma(t, a.z * (a.w * (2.0f * LN_2)), dy * (b.x * (2.0f * LN_2)));
        (*r).r0 += vec4<f32>(pulled, pt, py, pt * t);
        (*r).r1 += vec4<f32>(pt * dy, py * dy, w * slope, w * by_color.x);
        (*r).r2 += vec4<f32>(w * by_color.yz, abs(pt), abs(pulled) * abs(across));
    }
    return meets;
}

fn four_of(place: u32) -> vec4<f32> {
    return vec4<f32>(parts[place], parts[place + 1u], parts[place + 2u], parts[place + 3u]);
}

// Adds a record up over the threads of a team, and stores the twelve sums from `place` on. Two threads at a
// distance exchange halves: each keeps one half of its numbers and adds to it what the other thread had
// there. So the numbers of a thread halve with the distance, until each thread has one of sixteen sums; four
// are unused. The threads that remain then add the same number.
fn add_up(record: Record, lane: u32, place: u32) {
    let upper = (lane & (WIDTH / 2u)) != 0u;
    let none = vec4<f32>();
    let rest = subgroupShuffleXor(select(none, record.r1, upper), WIDTH / 2u);
    let far_half = subgroupShuffleXor(select(record.r2, record.r0, upper), WIDTH / 2u);
    let first = select(record.r0, record.r2, upper) + far_half;
    let second = select(record.r1, none, upper) + rest;
    let right = (lane & (WIDTH / 4u)) != 0u;
    var row = select(first, second, right) + subgroupShuffleXor(select(second, first, right), WIDTH / 4u);
    var at = place + select(0u, 8u, upper) + select(0u, 4u, right);
    var writes = !(upper && right);
    if (WIDTH == 4u) {
        if (writes) {
            for (var c = 0u; c < 4u; c++) { parts[at + c] = row[c]; }
        }
        return;
    }
    let third = (lane & (WIDTH / 8u)) != 0u;
    let pair = select(row.xy, row.zw, third) + subgroupShuffleXor(select(row.zw, row.xy, third), WIDTH / 8u);
    at += select(0u, 2u, third);
    if (WIDTH == 8u) {
        if (writes) {
            parts[at] = pair.x;
            parts[at + 1u] = pair.y;
        }
        return;
    }
    let odd = (lane & (WIDTH / 16u)) != 0u;
    var sum = select(pair.x, pair.y, odd) + subgroupShuffleXor(select(pair.y, pair.x, odd), WIDTH / 16u);
    at += select(0u, 1u, odd);
    for (var reach = WIDTH / 32u; reach > 0u; reach >>= 1u) { sum += subgroupShuffleXor(sum, reach); }
    writes = writes && (lane & (WIDTH / 16u - 1u)) == 0u;
    if (writes) { parts[at] = sum; }
}

// Smallest square of a number in the interval [low, high].
fn least_square(low: f32, high: f32) -> f32 {
    let nearest = max(max(low, -high), 0.0f);
    return nearest * nearest;
}

// True if a Gaussian may reach alpha = 1/255 in a rectangle. The test is looser than the test of a single
// pixel, by more than the rounding error.
fn reaches(a: vec4<f32>, b: vec4<f32>, low: vec2<f32>, high: vec2<f32>) -> bool {
    let y = vec2<f32>(low.y - a.y, high.y - a.y);
    let sheared = a.z * y;
    let x = vec2<f32>(low.x - a.x, high.x - a.x);
    let slack = 1e-5f * (max(abs(x.x), abs(x.y)) + max(abs(sheared.x), abs(sheared.y)));
    let t2 = least_square(x.x + min(sheared.x, sheared.y) - slack, x.y + max(sheared.x, sheared.y) + slack);
    let power = b.y - a.w * t2 - b.x * least_square(y.x, y.y);
    return power >= -LOG2_255 - 0.01f;
}

@compute @workgroup_size(WG)
fn main(
    @builtin(workgroup_id) wid: vec3<u32>,
    @builtin(num_workgroups) nwg: vec3<u32>,
    @builtin(local_invocation_index) lid: u32,
    @builtin(subgroup_id) team: u32,
    @builtin(subgroup_invocation_id) lane: u32,
    @builtin(subgroup_size) width: u32,
) {
    let tile = group_of(wid, nwg);
    if (tile >= constants.size.z * constants.size.w) { return; }
    let first = starts[tile];
    let count = starts[tile + 1u] - first;
    if (count == 0u) { return; }
    if (width != WIDTH) {
        let nan = bitcast<f32>(0x7fc00000u | width);
        for (var k = lid; k < count; k += WG) { records[3u * lists[first + k]] = vec4<f32>(nan); }
        return;
    }
    if (lid == 0u) { atomicStore(&last, 0u); }
    workgroupBarrier();
    // Uses the numbers of team and lane, since a device need not number subgroups in the order of threads.
    let own = EACH * (team * WIDTH + lane);
    // Four variables instead of an array, so that a thread's pixels stay in registers.
    var one = pixel_at(tile, place_of(own));
    var two = Pixel();
    var three = Pixel();
    var four = Pixel();
    var furthest = one.end;
    var corner = vec2<f32>(one.x, one.y);
    if (EACH > 1u) {
        two = pixel_at(tile, place_of(own + 1u));
        furthest = max(furthest, two.end);
        corner = vec2<f32>(two.x, two.y);
    }
    if (EACH > 2u) {
        three = pixel_at(tile, place_of(own + 2u));
        four = pixel_at(tile, place_of(own + 3u));
        furthest = max(furthest, max(three.end, four.end));
        corner = vec2<f32>(four.x, four.y);
    }
    atomicMax(&last, furthest);
    let team_end = subgroupMax(furthest);
    let low = subgroupMin(vec2<f32>(one.x, one.y));
    let high = subgroupMax(corner);
    workgroupBarrier();
    if (lid == 0u) { last_entry = min(count, atomicLoad(&last)); }
    let end = workgroupUniformLoad(&last_entry);
    // Entries behind the last stop of all pixels have no effect, so their records are zero.
    for (var k = end + lid; k < count; k += WG) {
        let entry = lists[first + k];
        for (var r = 0u; r < 3u; r++) { records[3u * entry + r] = vec4<f32>(); }
    }
    let s_gradient = f32(constants.flags.y);
    for (var base = 0u; base < end; base += ROUND) {
        let size = min(ROUND, end - base);
        // The last round's Gaussians were read before its second barrier, so none is needed here.
        if (lid < size) {
            let i = owners[lists[first + end - 1u - base - lid]];
            near[lid] = splats[3u * i];
            far[lid] = splats[3u * i + 1u];
            tint[lid] = splats[3u * i + 2u];
        }
        workgroupBarrier();
        for (var half = 0u; half < HALVES; half++) {
            let mine = half * WIDTH + lane;
            var meets = false;
            if (mine < size) {
                let k = end - 1u - base - mine;
                meets = k < team_end && reaches(near[mine], far[mine], low, high);
            }
            let ballot = subgroupBallot(meets);
            for (var word = 0u; word < WORDS; word++) {
                var bits = ballot[word];
                var hit = 0u;
                while (bits != 0u) {
                    let bit = firstTrailingBit(bits);
                    bits &= bits - 1u;
                    let j = half * WIDTH + 32u * word + bit;
                    let k = end - 1u - base - j;
                    let a = near[j];
                    let b = far[j];
                    let color = tint[j].xyz;
                    var record = Record();
                    var met = pass_by(&one, k, a, b, color, s_gradient, &record);
                    if (EACH > 1u) { met = pass_by(&two, k, a, b, color, s_gradient, &record) || met; }
                    if (EACH > 2u) {
                        met = pass_by(&three, k, a, b, color, s_gradient, &record) || met;
                        met = pass_by(&four, k, a, b, color, s_gradient, &record) || met;
                    }
                    if (subgroupAny(met)) {
                        hit |= 1u << bit;
                        add_up(record, lane, 12u * (team * ROUND + j));
                    }
                }
                if (lane == 0u) { hits[(HALVES * team + half) * WORDS + word] = hit; }
            }
        }
        workgroupBarrier();
        if (lid < size) {
            let half = lid / WIDTH;
            let at = lid % WIDTH;
            var record = Record();
            for (var t = 0u; t < TEAMS; t++) {
                if (((hits[(HALVES * t + half) * WORDS + at / 32u] >> (at % 32u)) & 1u) == 1u) {
                    let place = 12u * (t * ROUND + lid);
                    record.r0 += four_of(place);
                    record.r1 += four_of(place + 4u);
                    record.r2 += four_of(place + 8u);
                }
            }
            let entry = lists[first + end - 1u - base - lid];
            records[3u * entry] = record.r0;
            records[3u * entry + 1u] = record.r1;
            records[3u * entry + 2u] = record.r2;
        }
    }
}
