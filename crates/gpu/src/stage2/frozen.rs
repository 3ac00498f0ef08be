//! The constants of a view on the device: splats, lists without entries that no pixel sees, stage-1
//! colours, the field's lookups, the frozen water.
//!
//! The kernels of stage 1 project and list the scene for the view's lattice and draw it once. On a sparse
//! lattice most small Gaussians fall between the pixels. So the entries that some pixel sees are found, and
//! renumbered in main memory: once per view, not per step.

use use3d_capture::{Camera, Lattice, MediumMaps};
use use3d_enhance::Guidance;
use use3d_scene::Scene;
use use3d_training::EngineError;
use use3d_ubaf::{Field, Sites, water};

use super::kernels;
use super::weights::{FrozenWeights, WeightKernels};
use crate::buffer::{Array, read_together};
use crate::constants::{StepConstants, TILE, counts};
use crate::device::Gpu;
use crate::drawing::ray_lengths;
use crate::drawn::DrawnScene;
use crate::kernel::{Kernel, bound, submit};
use crate::lists::ViewLists;
use crate::raster::{DeviceCompositor, Outputs};
use crate::rows::Float4;

/// The frozen water of a view as planes, which the field recolours: the planes that the compositor reads
/// (`c_m`, and `k` with `e = 2^(−k z)`), then the signed logs of `c_m`.
fn frozen_water(
    gpu: &Gpu,
    camera: &Camera,
    lattice: &Lattice,
    maps: MediumMaps,
) -> Result<Array<f32>, EngineError> {
    let lengths = ray_lengths(camera, lattice);
    let k = |betas: &[f32]| -> Vec<f32> {
        let each = betas.iter().zip(lengths.iter().cycle());
        each.map(|(beta, length)| beta * length * std::f32::consts::LOG2_E).collect()
    };
    let water = water::ViewWater::new(maps);
    let mut planes = water.maps.color.data().to_vec();
    planes.extend(k(water.maps.attenuation.data()));
    planes.extend(k(water.maps.backscatter.data()));
    planes.extend(water.signed_logs.data());
    Array::from(gpu, "the water of a view", &planes)
}

/// A view's constants on the device.
#[derive(Debug)]
pub(super) struct FrozenView {
    pub(super) constants: Array<StepConstants>,
    pub(super) size: (usize, usize),
    pub(super) tiles: usize,
    /// Number of listed Gaussians: those that define the mean, then the others that the view sees.
    pub(super) listed: usize,
    /// Number of these that define the mean.
    pub(super) centred: usize,
    /// Number of (tile, Gaussian) entries.
    pub(super) entries: usize,
    axes: Array<f32>,
    starts: Array<u32>,
    lists: Array<u32>,
    pub(super) owners: Array<u32>,
    /// The splats, whose colours change with every step.
    pub(super) splats: Array<Float4>,
    /// The first entry and the number of entries of each Gaussian.
    pub(super) runs: Array<[u32; 2]>,
    /// Stage-1 colours.
    pub(super) base: Array<Float4>,
    /// The field's lookups of the listed Gaussians; with water, followed by the rows of its table.
    pub(super) sites: Array<[u32; 4]>,
    /// The frozen water: see [`frozen_water`].
    pub(super) water: Option<Array<f32>>,
    /// The weights of its pixels, unless there are too many.
    pub(super) weights: Option<FrozenWeights>,
}

impl FrozenView {
    /// The lists in the form that the compositor reads.
    pub(super) fn drawn(&self) -> ViewLists<'_> {
        let Self { axes, starts, lists, owners, splats, .. } = self;
        ViewLists { axes, starts, lists, owners, splats }
    }

    /// Number of pixels of its lattice.
    pub(super) fn pixels(&self) -> usize {
        self.size.0 * self.size.1
    }

    /// Number of bytes on the device.
    pub(super) fn bytes(&self) -> usize {
        let lists = self.starts.size() + self.lists.size() + self.owners.size() + self.runs.size();
        let rows = self.splats.size() + self.base.size() + self.sites.size();
        let weights = self.weights.as_ref().map_or(0, FrozenWeights::bytes);
        lists + rows + weights + self.axes.size() + self.water.as_ref().map_or(0, Array::size)
    }
}

/// The lists of a view as the device made them.
struct DeviceLists<'a> {
    /// The Gaussian of each entry.
    owners: &'a [u32],
    /// Entries by tile and by depth within a tile, and 1 for each entry that a pixel sees.
    lists: &'a [u32],
    seen: &'a [u32],
    /// The start of each tile's list; one more than there are tiles.
    starts: &'a [u32],
}

/// The lists without entries that no pixel sees, renumbered: Gaussians by their position in the list,
/// entries one Gaussian after another.
#[derive(Debug, PartialEq)]
struct Trimmed {
    listed: Vec<u32>,
    owners: Vec<u32>,
    lists: Vec<u32>,
    starts: Vec<u32>,
    runs: Vec<[u32; 2]>,
}

impl DeviceLists<'_> {
    /// Removes the unseen entries. `centred` are the Gaussians that define the mean; `None` for all of
    /// `gaussians`.
    fn trimmed(&self, gaussians: usize, centred: Option<&[u32]>) -> Trimmed {
        let every = |from: u32, to: u32| (from as usize..to as usize).filter(|&at| self.seen[at] != 0);
        let owner = |at: usize| self.owners[self.lists[at] as usize];
        let mut listed: Vec<u32> = match centred {
            Some(centred) => centred.to_vec(),
            None => (0..gaussians as u32).collect(),
        };
        let mut place = vec![u32::MAX; gaussians];
        (0..).zip(&listed).for_each(|(at, &i)| place[i as usize] = at);
        let mut others: Vec<u32> = Vec::new();
        let end = self.starts.last().copied().unwrap_or(0);
        for i in every(0, end).map(owner) {
            if place[i as usize] == u32::MAX {
                place[i as usize] = 0;
                others.push(i);
            }
        }
        others.sort_unstable();
        (listed.len() as u32..).zip(&others).for_each(|(at, &i)| place[i as usize] = at);
        listed.extend(others);
        let mut runs = vec![[0u32; 2]; listed.len()];
        every(0, end).for_each(|at| runs[place[owner(at) as usize] as usize][1] += 1);
        let mut entries = 0;
        for run in &mut runs {
            run[0] = entries;
            entries += run[1];
        }
        let mut next: Vec<u32> = runs.iter().map(|run| run[0]).collect();
        let (mut owners, mut lists) = (vec![0; entries as usize], Vec::with_capacity(entries as usize));
        let mut starts = vec![0];
        for tile in self.starts.windows(2) {
            for at in every(tile[0], tile[1]) {
                let i = place[owner(at) as usize];
                let entry = next[i as usize];
                next[i as usize] += 1;
                owners[entry as usize] = i;
                lists.push(entry);
            }
            starts.push(lists.len() as u32);
        }
        Trimmed { listed, owners, lists, starts, runs }
    }
}

/// The scene on the device, and the kernels that make views of it.
#[derive(Debug)]
pub(super) struct Freezer<'a> {
    scene: &'a Scene,
    drawn: DrawnScene,
    /// The sites at which its Gaussians look the field up.
    sites: std::sync::Arc<Sites>,
    centred: Option<Vec<u32>>,
    seen_kernel: Kernel,
    weights: WeightKernels,
    seen: Array<u32>,
}

impl<'a> Freezer<'a> {
    pub(super) fn new(
        gpu: &Gpu,
        scene: &'a Scene,
        sites: std::sync::Arc<Sites>,
        centred: Option<Vec<u32>>,
    ) -> Result<Self, EngineError> {
        Ok(Self {
            scene,
            drawn: DrawnScene::new(gpu, &scene.gaussians, "counts of a view")?,
            sites,
            centred,
            seen_kernel: Kernel::new(gpu, &kernels::seen())?,
            weights: WeightKernels::new(gpu)?,
            seen: Array::new(gpu, "seen entries", 1)?,
        })
    }

    /// Makes a view's constants; afterwards `compositor` has its stage-1 render, in the water in which
    /// `guidance` compares. `field` defines the position at which the water's table is looked up.
    pub(super) fn freeze(
        &mut self,
        compositor: &mut DeviceCompositor,
        field: &Field,
        camera: &Camera,
        lattice: &Lattice,
        guidance: Guidance<'_>,
    ) -> Result<FrozenView, EngineError> {
        let gpu = &self.drawn.gpu;
        let mut maps = MediumMaps::zeros(0, 0);
        let water = if guidance.look_through(self.scene, camera, lattice, &mut maps) {
            Some(frozen_water(gpu, camera, lattice, maps)?)
        } else {
            None
        };
        let constants = self.draw(compositor, camera, lattice, water.as_ref())?;
        let DrawnScene { gpu, count: n, lists, counts, .. } = &self.drawn;
        let (n, tiles) = (*n, constants.tiles());
        let starts = lists.starts.read(gpu, tiles + 1)?;
        let entries = starts.last().map_or(0, |&end| end as usize);
        let told = counts.read(gpu, counts::WORDS)?[counts::ENTRIES] as usize;
        let wanted = [
            (lists.splats.raw(), 12 * n),
            (lists.owners.raw(), told),
            (lists.entries().raw(), entries),
            (self.seen.raw(), entries),
        ];
        let [splats, owners, listed, seen] = read_together(gpu, wanted)?;
        let found = DeviceLists { owners: &owners, lists: &listed, seen: &seen, starts: &starts };
        let trimmed = found.trimmed(n, self.centred.as_deref());
        let rows: &[[u32; 4]] = splats.as_chunks().0;
        let row = |words: [u32; 4]| words.map(f32::from_bits);
        let own = |i: u32| &rows[3 * i as usize..3 * i as usize + 3];
        let of_listed = trimmed.listed.iter().flat_map(|&i| own(i).iter().map(|words| row(*words)));
        let splats: Vec<Float4> = of_listed.collect();
        let base: Vec<Float4> = trimmed.listed.iter().map(|&i| row(own(i)[2])).collect();
        let mut sites: Vec<[u32; 4]> = Vec::with_capacity(2 * (trimmed.listed.len() + water::ROWS));
        for &i in &trimmed.listed {
            let (nodes, fractions, logs) = self.sites.site(i as usize);
            sites.extend([position(nodes, fractions), with(logs, 0)]);
        }
        if water.is_some() {
            let center = camera.pose.center().as_vec3().to_array();
            let (nodes, fractions) = water::camera_site(field, center);
            for gamma in water::rows() {
                sites.extend([position(nodes, fractions), with([gamma, 0.0, 0.0], 1)]);
            }
        }
        let axes = lists.axes.read(gpu, (TILE * (constants.size[2] + constants.size[3])) as usize)?;
        let mut view = FrozenView {
            constants: Array::uniform(gpu, "constants of a view")?,
            size: (lattice.width(), lattice.height()),
            tiles,
            listed: trimmed.listed.len(),
            centred: self.centred.as_ref().map_or(n, Vec::len),
            entries: trimmed.lists.len(),
            axes: Array::from(gpu, "pixel centres", &axes)?,
            starts: Array::from(gpu, "list starts", &trimmed.starts)?,
            lists: Array::from(gpu, "lists", &trimmed.lists)?,
            owners: Array::from(gpu, "owners", &trimmed.owners)?,
            splats: Array::from(gpu, "splats", &splats)?,
            runs: Array::from(gpu, "runs", &trimmed.runs)?,
            base: Array::from(gpu, "stage-1 colours", &base)?,
            sites: Array::from(gpu, "lookups", &sites)?,
            water,
            weights: None,
        };
        view.constants.write(gpu, 0, &[constants]);
        view.weights = self.weights.weights(gpu, &view, &trimmed.owners)?;
        Ok(view)
    }

    /// Draws the scene of stage 1, and finds the entries that are seen.
    fn draw(
        &mut self,
        compositor: &mut DeviceCompositor,
        camera: &Camera,
        lattice: &Lattice,
        water: Option<&Array<f32>>,
    ) -> Result<StepConstants, EngineError> {
        let (degree, outputs) = (Some(self.scene.gaussians.sh_degree), Outputs::Training);
        let constants = self.drawn.draw(compositor, (camera, lattice), degree, water, None, outputs)?;
        let DrawnScene { gpu, lists, constants: uniform, .. } = &self.drawn;
        self.seen.grow(gpu, lists.capacity())?;
        submit(gpu, "a view", |pass| {
            let mut buffers = lists.drawn().buffers(uniform);
            buffers.extend(bound![compositor.kept, self.seen]);
            self.seen_kernel.record_groups(pass, constants.tiles(), buffers);
        })?;
        Ok(constants)
    }
}

/// The first row of a lookup: the bits of its fractions, and its nodes.
fn position(nodes: [u8; 3], fractions: [f32; 3]) -> [u32; 4] {
    with(fractions, u32::from_le_bytes([nodes[0], nodes[1], nodes[2], 0]))
}

/// A row of the bits of three numbers, and a word.
fn with(values: [f32; 3], word: u32) -> [u32; 4] {
    let [x, y, z] = values.map(f32::to_bits);
    [x, y, z, word]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_seen_is_numbered_anew_one_gaussian_after_another() {
        // Two tiles: Gaussian 4 is in both, Gaussian 1 in the first where no pixel sees it, Gaussian 2 in
        // the second.
        let found = DeviceLists {
            owners: &[4, 4, 1, 2, 2],
            lists: &[2, 0, 4, 1, 3],
            seen: &[0, 1, 1, 1, 0],
            starts: &[0, 3, 5],
        };
        let some = found.trimmed(6, Some(&[0, 2]));
        let expected = Trimmed {
            listed: vec![0, 2, 4],
            owners: vec![1, 2, 2],
            lists: vec![1, 0, 2],
            starts: vec![0, 2, 3],
            runs: vec![[0, 0], [0, 1], [1, 2]],
        };
        assert_eq!(some, expected);
        let all = found.trimmed(6, None);
        assert_eq!((all.listed.len(), &all.owners[..]), (6, &[2, 4, 4][..]));
        let nothing =
            DeviceLists { owners: &[], lists: &[], seen: &[], starts: &[0, 0] }.trimmed(3, Some(&[1]));
        assert_eq!((nothing.listed, nothing.starts, nothing.lists.len()), (vec![1], vec![0, 0], 0));
    }
}
