//! A capture's observations in the form that all channels share: sorted, with the informative points, in
//! units of the median distance.

use glam::DVec3;
use use3d_numerics::order::Ascending;

use crate::blocks::{self, blocks};
use crate::formation::Channel;
use crate::observe::{Observation, Sights};
use crate::open::{Open, OpenWater};
use crate::params::WaterParams;

/// The data that all channels share.
pub(crate) struct Data {
    /// Sorted so that the caller's order does not matter.
    pub(crate) observations: Vec<Observation>,
    pub(crate) open: Vec<OpenWater>,
    /// Indices of informative tracks, sorted by position.
    pub(crate) order: Vec<usize>,
    /// The block of neighbours to which a point of `order` belongs, indexed by track.
    pub(crate) block: Vec<usize>,
    /// Number of blocks.
    pub(crate) blocks: usize,
    /// Observation ranges of tracks.
    pub(crate) ranges: Vec<std::ops::Range<usize>>,
    pub(crate) unit: f64,
    pub(crate) center: DVec3,
    pub(crate) views: usize,
    pub(crate) telling: usize,
    pub(crate) percentiles: [f64; 3],
}

impl Data {
    pub(crate) fn new(
        sights: &Sights,
        points: usize,
        positions: &[DVec3],
        views: usize,
        params: &WaterParams,
    ) -> Self {
        let finite = |o: &&Observation| {
            o.point < points.min(positions.len())
                && o.view < views
                && o.distance.is_finite()
                && o.distance > 0.0
                && o.direction.is_finite()
        };
        let mut sorted: Vec<Observation> = sights.points.iter().filter(finite).copied().collect();
        sorted.sort_by_key(|o| (o.point, o.view));
        sorted.dedup_by_key(|o| (o.point, o.view));
        let mut ranges = vec![0..0; points];
        let mut first = 0;
        for views in sorted.chunk_by(|a, b| a.point == b.point) {
            ranges[views[0].point] = first..first + views.len();
            first += views.len();
        }
        let ratio = |range: &std::ops::Range<usize>| {
            let all = sorted[range.clone()].iter().map(|o| o.distance);
            let (near, far) = all.fold((f64::INFINITY, 0.0f64), |(n, f), s| (n.min(s), f.max(s)));
            far / near
        };
        let tells = |p: &usize| ranges[*p].len() >= 3 && ratio(&ranges[*p]) >= params.distance_ratio;
        let telling = (0..points).filter(tells).count();
        // Points over a smaller range of distances carry less information, but cost little and stabilise
        // the gains.
        let mut order: Vec<usize> =
            (0..points).filter(|p| ranges[*p].len() >= 3 && ratio(&ranges[*p]) >= 1.1).collect();
        order.sort_by(|a, b| blocks::order(&positions[*a].to_array(), &positions[*b].to_array()));
        let places: Vec<DVec3> = order.iter().map(|p| positions[*p]).collect();
        let (of_order, blocks) = blocks(&places);
        let mut block = vec![0; points];
        order.iter().zip(of_order).for_each(|(p, b)| block[*p] = b);
        let used: Vec<&Observation> = order.iter().flat_map(|p| &sorted[ranges[*p].clone()]).collect();
        let distances = Ascending::of(used.iter().map(|o| o.distance));
        let percentiles = [0.05, 0.5, 0.95].map(|share| distances.at(share).unwrap_or(1.0));
        let sum: DVec3 = used.iter().map(|o| o.direction).sum();
        let center = sum / (used.len().max(1) as f64);
        let open = if params.open_water { Open::usable(&sights.open, views) } else { vec![] };
        Self {
            order,
            open,
            block,
            blocks,
            ranges,
            unit: percentiles[1],
            center,
            views,
            telling,
            percentiles,
            observations: sorted,
        }
    }

    /// A channel's observations of every `step`-th informative point, and those points.
    pub(crate) fn select(&self, c: usize, step: usize) -> (Channel, Vec<usize>) {
        let mut channel = Channel { start: vec![0], views: self.views, ..Channel::default() };
        let mut points = Vec::new();
        for &p in self.order.iter().step_by(step) {
            let usable: Vec<&Observation> = self.observations[self.ranges[p].clone()]
                .iter()
                .filter(|o| o.value[c].is_finite() && o.spread[c].is_finite())
                .collect();
            if usable.len() < 2 {
                continue;
            }
            for o in usable {
                channel.view.push(o.view);
                channel.distance.push(o.distance / self.unit);
                channel.direction.push((o.direction - self.center).to_array());
                channel.value.push(o.value[c]);
                channel.spread.push(o.spread[c]);
            }
            channel.start.push(channel.value.len());
            points.push(p);
        }
        (channel, points)
    }
}
