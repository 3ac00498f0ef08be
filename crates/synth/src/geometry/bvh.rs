//! A four-wide tree of bounding boxes over triangles, to find the nearest hit along a ray.
//!
//! It is built by the binned surface-area heuristic, then collapsed to four children per node, so that the
//! slab tests of four boxes and the intersection tests of four triangles (Möller and Trumbore) run in
//! parallel in vector registers.

use glam::Vec3;

/// A half-line. `direction` need not be a unit vector; distances are in multiples of its length.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Ray {
    pub(crate) origin: Vec3,
    pub(crate) direction: Vec3,
}

/// The hit of a ray on a triangle: `t` along the ray, and the barycentric weights of its second and third
/// vertex.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Hit {
    pub(crate) t: f32,
    pub(crate) triangle: u32,
    pub(crate) u: f32,
    pub(crate) v: f32,
}

type Four = [f32; 4];

#[derive(Clone, Debug)]
struct BvhNode {
    min: [Four; 3],
    max: [Four; 3],
    /// Index of a node; of a pack if the high bit is set; or `EMPTY`.
    child: [u32; 4],
}

/// Up to four triangles: a vertex and two edges each.
#[derive(Clone, Debug)]
struct Pack {
    vertex: [Four; 3],
    edge1: [Four; 3],
    edge2: [Four; 3],
    triangle: [u32; 4],
}

const EMPTY: u32 = u32::MAX;
const LEAF: u32 = 1 << 31;
const BINS: usize = 12;
/// Triangles are extended by this share of an edge: rounding must not let a ray pass between two of them.
const SLACK: f32 = 5e-5;

/// The tree.
#[derive(Clone, Debug, Default)]
pub(crate) struct Bvh {
    nodes: Vec<BvhNode>,
    packs: Vec<Pack>,
}

#[derive(Clone, Copy, Debug)]
struct Bounds {
    min: Vec3,
    max: Vec3,
}

impl Bounds {
    const NONE: Self = Self { min: Vec3::MAX, max: Vec3::MIN };

    fn union(self, other: Self) -> Self {
        Self { min: self.min.min(other.min), max: self.max.max(other.max) }
    }

    fn area(&self) -> f32 {
        let d = (self.max - self.min).max(Vec3::ZERO);
        d.x * d.y + d.y * d.z + d.z * d.x
    }
}

#[derive(Clone, Copy, Debug)]
struct Item {
    bounds: Bounds,
    triangle: u32,
}

impl Item {
    fn center(&self) -> Vec3 {
        0.5 * (self.bounds.min + self.bounds.max)
    }
}

enum Tree {
    Leaf(Bounds, Vec<u32>),
    Inner(Bounds, Box<[Tree; 2]>),
}

impl Tree {
    fn bounds(&self) -> Bounds {
        match self {
            Self::Leaf(b, _) | Self::Inner(b, _) => *b,
        }
    }
}

fn build(items: &mut [Item]) -> Tree {
    let bounds = items.iter().fold(Bounds::NONE, |b, i| b.union(i.bounds));
    if items.len() <= 4 {
        return Tree::Leaf(bounds, items.iter().map(|i| i.triangle).collect());
    }
    let middle = split(items);
    let (left, right) = items.split_at_mut(middle);
    let (left, right) = if left.len() + right.len() > 20_000 {
        rayon::join(|| build(left), || build(right))
    } else {
        (build(left), build(right))
    };
    Tree::Inner(bounds, Box::new([left, right]))
}

/// Partitions at the cheapest of a few planes and returns the start of the second part (neither part is
/// empty).
fn split(items: &mut [Item]) -> usize {
    let centers = items.iter().map(|i| Bounds { min: i.center(), max: i.center() });
    let centers = centers.fold(Bounds::NONE, Bounds::union);
    let extent = centers.max - centers.min;
    let axis = extent.max_position();
    if extent[axis] <= 0.0 {
        return items.len() / 2;
    }
    let scale = BINS as f32 / extent[axis];
    let bin = |i: &Item| (((i.center()[axis] - centers.min[axis]) * scale) as usize).min(BINS - 1);
    let (mut counts, mut boxes) = ([0usize; BINS], [Bounds::NONE; BINS]);
    for item in items.iter() {
        let b = bin(item);
        counts[b] += 1;
        boxes[b] = boxes[b].union(item.bounds);
    }
    let mut right_cost = [0.0f32; BINS];
    let (mut bounds, mut count) = (Bounds::NONE, 0);
    for b in (1..BINS).rev() {
        bounds = bounds.union(boxes[b]);
        count += counts[b];
        right_cost[b] = bounds.area() * count as f32;
    }
    let (mut best, mut best_cost) = (0, f32::MAX);
    let (mut bounds, mut count) = (Bounds::NONE, 0);
    for b in 0..BINS - 1 {
        bounds = bounds.union(boxes[b]);
        count += counts[b];
        let cost = bounds.area() * count as f32 + right_cost[b + 1];
        if count > 0 && count < items.len() && cost < best_cost {
            (best, best_cost) = (b, cost);
        }
    }
    let mut middle = 0;
    for i in 0..items.len() {
        if bin(&items[i]) <= best {
            items.swap(i, middle);
            middle += 1;
        }
    }
    if middle == 0 || middle == items.len() { items.len() / 2 } else { middle }
}

impl Bvh {
    /// Builds the tree over triangles of `positions`.
    pub(crate) fn build(positions: &[Vec3], triangles: &[[u32; 3]]) -> Self {
        let corners = |t: u32| triangles[t as usize].map(|i| positions[i as usize]);
        let item = |triangle: u32| {
            let bounds = corners(triangle).map(|p| Bounds { min: p, max: p });
            Item { bounds: bounds.into_iter().fold(Bounds::NONE, Bounds::union), triangle }
        };
        let mut items: Vec<Item> = (0..triangles.len() as u32).map(item).collect();
        let mut bvh = Self::default();
        if items.is_empty() {
            return bvh;
        }
        let tree = build(&mut items);
        match tree {
            // The root is always a node.
            leaf @ Tree::Leaf(..) => bvh.add_node(vec![leaf], &corners),
            Tree::Inner(_, children) => bvh.add_node(Vec::from(children as Box<[Tree]>), &corners),
        };
        bvh
    }

    /// Adds a node over two to four subtrees and returns its index.
    fn add_node(&mut self, mut children: Vec<Tree>, corners: &dyn Fn(u32) -> [Vec3; 3]) -> u32 {
        while children.len() < 4 {
            let largest = (0..children.len())
                .filter(|&i| matches!(children[i], Tree::Inner(..)))
                .max_by(|&a, &b| children[a].bounds().area().total_cmp(&children[b].bounds().area()));
            let Some(Tree::Inner(_, pair)) = largest.map(|i| children.remove(i)) else { break };
            children.extend(pair as Box<[Tree]>);
        }
        let index = self.nodes.len();
        self.nodes.push(BvhNode {
            min: [[f32::INFINITY; 4]; 3],
            max: [[f32::NEG_INFINITY; 4]; 3],
            child: [EMPTY; 4],
        });
        for (slot, child) in children.into_iter().enumerate() {
            let bounds = child.bounds();
            for axis in 0..3 {
                self.nodes[index].min[axis][slot] = bounds.min[axis];
                self.nodes[index].max[axis][slot] = bounds.max[axis];
            }
            self.nodes[index].child[slot] = match child {
                Tree::Leaf(_, list) => LEAF | self.add_pack(&list, corners),
                Tree::Inner(_, pair) => self.add_node(Vec::from(pair as Box<[Tree]>), corners),
            };
        }
        index as u32
    }

    fn add_pack(&mut self, list: &[u32], corners: &dyn Fn(u32) -> [Vec3; 3]) -> u32 {
        // Unused lanes keep zero edges: their determinant is 0 and they are never hit.
        let zero = [[0.0; 4]; 3];
        let mut pack = Pack { vertex: zero, edge1: zero, edge2: zero, triangle: [EMPTY; 4] };
        for (lane, &t) in list.iter().enumerate() {
            let [a, b, c] = corners(t);
            for axis in 0..3 {
                pack.vertex[axis][lane] = a[axis];
                pack.edge1[axis][lane] = b[axis] - a[axis];
                pack.edge2[axis][lane] = c[axis] - a[axis];
            }
            pack.triangle[lane] = t;
        }
        self.packs.push(pack);
        self.packs.len() as u32 - 1
    }

    /// The nearest triangle with `0 < t < far`, from either side.
    pub(crate) fn nearest(&self, ray: &Ray, far: f32) -> Option<Hit> {
        self.trace(ray, far, false)
    }

    /// Any triangle with `0 < t < far`.
    pub(crate) fn any(&self, ray: &Ray, far: f32) -> Option<Hit> {
        self.trace(ray, far, true)
    }

    fn trace(&self, ray: &Ray, far: f32, any: bool) -> Option<Hit> {
        if self.nodes.is_empty() {
            return None;
        }
        // A zero component is replaced by a tiny one: its reciprocal stays finite and 0 * infinity cannot
        // occur.
        let safe = |d: f32| if d.abs() < 1e-20 { 1e-20f32.copysign(d) } else { d };
        let inverse = ray.direction.to_array().map(|d| 1.0 / safe(d));
        let origin = ray.origin.to_array();
        let mut best: Option<Hit> = None;
        let mut limit = far;
        let mut stack = [(0u32, 0.0f32); 96];
        let mut top = 1;
        while top > 0 {
            top -= 1;
            let (index, near) = stack[top];
            if near >= limit {
                continue;
            }
            if index & LEAF != 0 {
                if let Some(hit) = self.packs[(index & !LEAF) as usize].intersect(ray, limit) {
                    limit = hit.t;
                    best = Some(hit);
                    if any {
                        return best;
                    }
                }
                continue;
            }
            let node = &self.nodes[index as usize];
            let (mut entry, mut exit) = ([0.0f32; 4], [limit; 4]);
            for axis in 0..3 {
                let (lo, hi) = if inverse[axis] >= 0.0 {
                    (&node.min[axis], &node.max[axis])
                } else {
                    (&node.max[axis], &node.min[axis])
                };
                for k in 0..4 {
                    let t0 = (lo[k] - origin[axis]) * inverse[axis];
                    let t1 = (hi[k] - origin[axis]) * inverse[axis];
                    entry[k] = if t0 > entry[k] { t0 } else { entry[k] };
                    exit[k] = if t1 < exit[k] { t1 } else { exit[k] };
                }
            }
            // Insertion by distance: the nearest child ends on top of the stack.
            let first = top;
            for k in 0..4 {
                // The tolerance is a few units in the last place: a flat box must not be missed because of
                // rounding.
                if entry[k] <= exit[k] * 1.000_000_5 && node.child[k] != EMPTY && top < stack.len() {
                    let mut slot = top;
                    while slot > first && stack[slot - 1].1 < entry[k] {
                        stack[slot] = stack[slot - 1];
                        slot -= 1;
                    }
                    stack[slot] = (node.child[k], entry[k]);
                    top += 1;
                }
            }
        }
        best
    }
}

impl Pack {
    #[inline]
    fn intersect(&self, ray: &Ray, limit: f32) -> Option<Hit> {
        let (o, d) = (ray.origin.to_array(), ray.direction.to_array());
        let (e1, e2) = (&self.edge1, &self.edge2);
        let (mut t, mut u, mut v, mut good) = ([0.0f32; 4], [0.0f32; 4], [0.0f32; 4], [false; 4]);
        for k in 0..4 {
            let p = [
                d[1] * e2[2][k] - d[2] * e2[1][k],
                d[2] * e2[0][k] - d[0] * e2[2][k],
                d[0] * e2[1][k] - d[1] * e2[0][k],
            ];
            let determinant = e1[0][k] * p[0] + e1[1][k] * p[1] + e1[2][k] * p[2];
            let inverse = 1.0 / determinant;
            let s = [o[0] - self.vertex[0][k], o[1] - self.vertex[1][k], o[2] - self.vertex[2][k]];
            u[k] = (s[0] * p[0] + s[1] * p[1] + s[2] * p[2]) * inverse;
            let q = [
                s[1] * e1[2][k] - s[2] * e1[1][k],
                s[2] * e1[0][k] - s[0] * e1[2][k],
                s[0] * e1[1][k] - s[1] * e1[0][k],
            ];
            v[k] = (d[0] * q[0] + d[1] * q[1] + d[2] * q[2]) * inverse;
            t[k] = (e2[0][k] * q[0] + e2[1][k] * q[1] + e2[2][k] * q[2]) * inverse;
            // A determinant of 0 gives infinities or NaN, which fail these comparisons.
            let inside = (u[k] >= -SLACK) & (v[k] >= -SLACK) & (u[k] + v[k] <= 1.0 + SLACK);
            good[k] = inside & (t[k] > 0.0) & (t[k] < limit);
        }
        let (mut best, mut nearest) = (None, limit);
        for k in 0..4 {
            if good[k] && t[k] < nearest {
                nearest = t[k];
                best = Some(Hit { t: t[k], triangle: self.triangle[k], u: u[k], v: v[k] });
            }
        }
        best
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use use3d_numerics::random::{Purpose, Stream};

    #[test]
    fn the_tree_finds_what_testing_every_triangle_finds() {
        let draws = Stream::new(1, Purpose::new("bvh test"), 0);
        let number = |i: usize| draws.uniform(i as u64) as f32 * 2.0 - 1.0;
        let positions: Vec<Vec3> = (0..900)
            .map(|i| {
                let center =
                    Vec3::new(number(10_000 + i / 3), number(20_000 + i / 3), number(30_000 + i / 3));
                center + 0.2 * Vec3::new(number(3 * i), number(3 * i + 1), number(3 * i + 2))
            })
            .collect();
        let triangles: Vec<[u32; 3]> = (0..300).map(|i| [3 * i, 3 * i + 1, 3 * i + 2]).collect();
        let bvh = Bvh::build(&positions, &triangles);
        let mut hits = 0;
        for i in 0..2000 {
            let origin = 2.0 * Vec3::new(number(40_000 + i), number(50_000 + i), number(60_000 + i));
            let direction = if i % 7 == 0 { Vec3::X } else { -origin.normalize() };
            let ray = Ray { origin, direction };
            let slow = triangles
                .iter()
                .enumerate()
                .filter_map(|(t, c)| {
                    let [a, b, c] = c.map(|i| positions[i as usize]);
                    let (e1, e2) = (b - a, c - a);
                    let p = direction.cross(e2);
                    let inverse = 1.0 / e1.dot(p);
                    let (s, q) = (origin - a, (origin - a).cross(e1));
                    let (u, v, d) = (s.dot(p) * inverse, direction.dot(q) * inverse, e2.dot(q) * inverse);
                    let inside = u >= -SLACK && v >= -SLACK && u + v <= 1.0 + SLACK;
                    (inside && d > 0.0).then_some((d, t as u32))
                })
                .min_by(|a, b| a.0.total_cmp(&b.0));
            let fast = bvh.nearest(&ray, f32::INFINITY);
            assert_eq!(fast.map(|h| h.triangle), slow.map(|s| s.1));
            assert_eq!(bvh.any(&ray, f32::INFINITY).is_some(), slow.is_some());
            hits += usize::from(fast.is_some());
        }
        assert!(hits > 200);
        assert!(Bvh::build(&[], &[]).nearest(&Ray { origin: Vec3::ZERO, direction: Vec3::X }, 1.0).is_none());
    }

    #[test]
    fn no_ray_slips_between_triangles() {
        // A fine sheet far from the origin, where rounding errors are largest.
        let (n, step) = (60usize, 0.05f32);
        let positions: Vec<Vec3> = (0..=n * (n + 2))
            .map(|i| Vec3::new(7.0 + step * (i % (n + 1)) as f32, 9.0 + step * (i / (n + 1)) as f32, 0.1))
            .collect();
        let mut triangles = Vec::new();
        for j in 0..n {
            for i in 0..n {
                let at = |i: usize, j: usize| (j * (n + 1) + i) as u32;
                triangles.push([at(i, j), at(i + 1, j), at(i + 1, j + 1)]);
                triangles.push([at(i, j), at(i + 1, j + 1), at(i, j + 1)]);
            }
        }
        let bvh = Bvh::build(&positions, &triangles);
        let eye = Vec3::new(0.3, -0.7, 1.7);
        for i in 0..60_000usize {
            // The rays deliberately pass through the diagonals and the edges.
            let along = 0.1 + 2.8 * (i as f32 / 60_000.0);
            let across = step * (1 + i % 58) as f32;
            let target =
                if i % 2 == 0 { Vec3::new(along, along, 0.0) } else { Vec3::new(along, across, 0.0) };
            let direction = Vec3::new(7.0, 9.0, 0.1) + target - eye;
            assert!(bvh.nearest(&Ray { origin: eye, direction }, 2.0).is_some(), "ray {i} slipped through");
        }
    }
}
