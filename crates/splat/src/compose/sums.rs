//! From gradient records of (tile, Gaussian) entries to gradients of Gaussians, in a fixed order and without atomics.
//!
//! Tile rows are handled in groups of at most [`GROUP`] entries (or one row), so that the records' buffer is bounded; after a
//! group, each Gaussian adds its records in the order of tiles. Groups follow one another, so the order of additions
//! is the order of tiles whatever the grouping and the number of threads.

use std::ops::Range;

use fearless_simd::{Level, dispatch};
use rayon::prelude::*;
use use3d_capture::Camera;
use use3d_numerics::math;

use crate::prepared::{ColorSource, HIDDEN, Prepared, Splat, TileRow};
use crate::projection::Projector;
use crate::strips::{Strips, for_each};
use crate::tile::Record;
use crate::{GaussianGradients, Gaussians, color};

/// Entries whose records are held at once (unless one tile row alone has more).
const GROUP: usize = 1 << 20;
/// Gaussians per parallel task.
const CHUNK: usize = 512;

/// The records of consecutive tile rows.
struct Records<'a> {
    rows: &'a [TileRow],
    records: &'a mut [Record],
}

impl Strips for Records<'_> {
    fn cut(self, tile_rows: usize, _at: usize) -> (Self, Self) {
        let (first, second) = self.rows.split_at(tile_rows);
        let entries = first.iter().map(|row| row.entries.len()).sum();
        let (a, b) = self.records.split_at_mut(entries);
        (Self { rows: first, records: a }, Self { rows: second, records: b })
    }
}

/// Runs `work(tile row, its records, its strips)` over all tile rows and sums the records of each visible Gaussian into `sums` (by
/// rank). `work` must write every record.
pub(crate) fn in_groups<T: Strips>(
    prepared: &Prepared,
    records: &mut Vec<Record>,
    sums: &mut Vec<Record>,
    strips: T,
    work: &(impl Fn(usize, &mut [Record], T) + Sync),
) {
    let rows = &prepared.tile_rows;
    sums.clear();
    sums.resize(prepared.splats.len(), [0.0; 12]);
    let mut strips = Some(strips);
    let mut first = 0;
    while first < rows.len() {
        let (mut last, mut entries) = (first, 0);
        while last < rows.len() && (last == first || entries + rows[last].entries.len() <= GROUP) {
            entries += rows[last].entries.len();
            last += 1;
        }
        if records.len() < entries {
            records.resize(entries, [0.0; 12]);
        }
        let Some(rest) = strips.take() else { break };
        let (here, rest) = rest.cut(last - first, last);
        strips = Some(rest);
        let group = Records { rows: &rows[first..last], records: &mut records[..entries] };
        for_each(first..last, (group, here), &|row, (group, strips): (Records<'_>, T)| {
            work(row, group.records, strips);
        });
        add(&rows[first..last], &records[..entries], sums);
        first = last;
    }
}

/// Adds the records of some tile rows to the sums.
fn add(rows: &[TileRow], records: &[Record], sums: &mut [Record]) {
    let level = Level::new();
    sums.par_chunks_mut(CHUNK).enumerate().for_each(|(chunk, sums)| {
        dispatch!(level, _simd => add_chunk(rows, records, (chunk * CHUNK) as u32, sums));
    });
}

/// Adds the records of the Gaussians whose ranks begin at `base`.
#[inline(always)]
fn add_chunk(rows: &[TileRow], records: &[Record], base: u32, sums: &mut [Record]) {
    let ranks: Range<u32> = base..base + sums.len() as u32;
    let mut start = 0;
    for row in rows {
        let from = row.spans.partition_point(|s| s.rank < ranks.start);
        for span in row.spans[from..].iter().take_while(|s| s.rank < ranks.end) {
            let sum = &mut sums[(span.rank - base) as usize];
            let first = start + span.start as usize;
            for record in &records[first..first + span.count as usize] {
                for (s, r) in sum.iter_mut().zip(record) {
                    *s += r;
                }
            }
        }
        start += row.entries.len();
    }
}

/// `out[index] = value(sum)` for every Gaussian; zero (the default) where it is not visible.
pub(crate) fn scatter<T: Copy + Default + Send>(
    prepared: &Prepared,
    sums: &[Record],
    out: &mut [T],
    value: impl Fn(&Record) -> T + Sync,
) {
    out.par_chunks_mut(CHUNK).zip(prepared.ranks.par_chunks(CHUNK)).for_each(|(out, ranks)| {
        for (out, &rank) in out.iter_mut().zip(ranks) {
            *out = if rank == HIDDEN { T::default() } else { value(&sums[rank as usize]) };
        }
    });
}

/// From sums of records to gradients of raw parameters. Overwrites `grads`.
pub(crate) fn backward_gaussians(
    prepared: &Prepared,
    sums: &[Record],
    gaussians: &Gaussians,
    camera: &Camera,
    grads: &mut GaussianGradients,
) {
    grads.resize(gaussians.len());
    let (projector, center) = (Projector::new(camera), color::center(camera));
    let view = View { prepared, sums, gaussians, projector, center };
    let level = Level::new();
    let GaussianGradients { means, log_scales, quaternions, opacity_logits, sh, screen, visible } = grads;
    (
        means.par_chunks_mut(CHUNK),
        log_scales.par_chunks_mut(CHUNK),
        quaternions.par_chunks_mut(CHUNK),
        opacity_logits.par_chunks_mut(CHUNK),
        sh.par_chunks_mut(CHUNK),
        screen.par_chunks_mut(CHUNK),
        visible.par_chunks_mut(CHUNK),
        prepared.ranks.par_chunks(CHUNK),
    )
        .into_par_iter()
        .enumerate()
        .for_each(|(chunk, (means, scales, quats, logits, sh, screen, visible, ranks))| {
            let out = Chunk { means, scales, quats, logits, sh, screen, visible };
            dispatch!(level, _simd => backward_chunk(&view, chunk * CHUNK, ranks, out));
        });
}

/// What the gradients of a view's Gaussians are made from.
struct View<'a> {
    prepared: &'a Prepared,
    sums: &'a [Record],
    gaussians: &'a Gaussians,
    projector: Projector,
    center: [f32; 3],
}

/// The gradients of consecutive Gaussians.
struct Chunk<'a> {
    means: &'a mut [[f32; 3]],
    scales: &'a mut [[f32; 3]],
    quats: &'a mut [[f32; 4]],
    logits: &'a mut [f32],
    sh: &'a mut [[[f32; 3]; 16]],
    screen: &'a mut [[f32; 2]],
    visible: &'a mut [bool],
}

/// The gradients of the Gaussians from `first` on. Always inlined, so that the instruction set reaches it: multiply-add is a call
/// without.
#[inline(always)]
fn backward_chunk(view: &View<'_>, first: usize, ranks: &[u32], out: Chunk<'_>) {
    let View { prepared, sums, gaussians, projector, center } = view;
    let Chunk { means, scales, quats, logits, sh, screen, visible } = out;
    // Ranks are scattered over the view: fetched together, the waits for memory overlap.
    let mut fetched = [(Splat::default(), [0.0; 12]); CHUNK];
    for (fetched, &rank) in fetched.iter_mut().zip(ranks) {
        if rank != HIDDEN {
            *fetched = (prepared.splats[rank as usize], sums[rank as usize]);
        }
    }
    for (i, &rank) in ranks.iter().enumerate() {
        visible[i] = rank != HIDDEN;
        if rank == HIDDEN {
            (means[i], scales[i], quats[i]) = ([0.0; 3], [0.0; 3], [0.0; 4]);
            (logits[i], sh[i], screen[i]) = (0.0, [[0.0; 3]; 16], [0.0; 2]);
            continue;
        }
        let index = first + i;
        let (splat, sum) = &fetched[i];
        let s = sum.map(f64::from);
        // v = conic · (pixel − centre) = (a t, shear a t + dy / cov_yy), a = conic_xx.
        let twice = 2.0 * std::f64::consts::LN_2;
        let (k, a, b) = (
            f64::from(splat.shear),
            f64::from(splat.steepness) * twice,
            f64::from(splat.steepness_y) * twice,
        );
        let d_mean = [a * s[1], k * a * s[1] + b * s[2]];
        let xx = a * a * s[3];
        let xy = k * xx + a * b * s[4];
        let yy = k * (2.0 * xy - k * xx) + b * b * s[5];
        let d_z = s[6] * std::f64::consts::LN_2;
        let g = projector.backward(
            gaussians.means[index],
            gaussians.log_scales[index],
            gaussians.quaternions[index],
            d_mean,
            d_z,
            [0.5 * xx, xy, 0.5 * yy],
        );
        means[i] = g.mean.map(|v| v as f32);
        scales[i] = g.log_scale.map(|v| v as f32);
        quats[i] = g.quaternion.map(|v| v as f32);
        // α = o e^{-σ}, so ∂L/∂logit = (1 − o) Σ α ∂L/∂α.
        let closed = 1.0 / (1.0 + math::exp(f64::from(gaussians.opacity_logits[index])));
        logits[i] = (closed * s[0]) as f32;
        screen[i] = [(a * s[10]) as f32, s[11] as f32];
        match prepared.color_source {
            ColorSource::Harmonics(degree) => color::color_backward(
                degree,
                *center,
                gaussians.means[index],
                &gaussians.sh[index],
                [sum[7], sum[8], sum[9]],
                &mut sh[i],
            ),
            ColorSource::Given => sh[i] = [[0.0; 3]; 16],
        }
    }
}
