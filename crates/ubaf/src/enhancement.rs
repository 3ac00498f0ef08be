//! The trained field as a scene stores it: constants only, independent of which Gaussians are drawn.
//!
//! When training ends, the mean that [`crate::objects`] removes is stored as `centre` (R22). From then on a
//! Gaussian's grade depends only on its own position and colour, so that a crop, a merged scene or a single
//! Gaussian keeps its colours.
//!
//! **Strength** `s` in `[0, 1]` scales every deviation from the identity in its own space: log-gain, bias,
//! affine minus identity, and transport log-ratio. `s = 0` is exactly the reconstruction and `s = 1`
//! exactly the enhanced scene. The path between is smooth and keeps gains positive; it is not a blend of
//! the two images.
//!
//! **Appearance.** A field that was learnt in clear radiance changes the objects' own colours only; the
//! water then stays as stage 1 found it.
//!
//! **Kept water.** A field that was learnt in thinner water ([`KeptWater`]) is shown in the same thinner
//! water: the stage-1 coefficients are multiplied by the kept share before the field grades them. At
//! strength `s` the share is `1 + s (k − 1)`.

use fearless_simd::{Level, Simd, dispatch};
use rayon::prelude::*;
use use3d_capture::{Appearance, KeptWater, MediumMaps};

use crate::OUTPUTS;
use crate::field::{Field, apply_affine};
use crate::objects::ObjectPass;
use crate::water::{ViewWater, WaterPass};
use use3d_numerics::lanes::exp;

/// Gaussians per parallel task.
const CHUNK: usize = 4096;

/// A trained field and its constant mode.
#[derive(Clone, Debug, PartialEq)]
pub struct Enhancement {
    /// Parameters and box.
    pub field: Field,
    /// The constant mode of the field's raw outputs: their mean over the scene's Gaussians when training
    /// ended.
    pub centre: [f32; OUTPUTS],
    /// The appearance in which it was learnt, and so the part that it changes: objects and water, or
    /// objects alone. It is not among the tensors; the scene's description stores it.
    pub appearance: Appearance,
    /// The share of the stage-1 water in which the field was learnt and which the enhanced scene keeps. The
    /// scene's description stores it, too.
    pub kept_water: KeptWater,
}

/// A per-Gaussian affine colour map `c⁺ = exp(s a) ⊙ (c + s (δA c + b_g)) + s b`, ready for any view.
#[derive(Clone, Debug, PartialEq)]
pub struct ObjectGrades {
    affine: [[f32; 4]; 3],
    /// Per Gaussian: gain RGB, bias RGB.
    grades: Vec<[f32; OUTPUTS]>,
}

impl Enhancement {
    /// The grades of Gaussians at `means` whose SH band 0 is `sh_dc`, at `strength` in `[0, 1]`.
    pub fn objects(
        &self,
        means: &[[f32; 3]],
        sh_dc: impl ExactSizeIterator<Item = [f32; 3]>,
        strength: f32,
    ) -> ObjectGrades {
        let mut pass = ObjectPass::new(&self.field, means, sh_dc);
        pass.forward(&self.field);
        let mut grades = pass.locals(self.centre);
        grades.par_iter_mut().with_min_len(CHUNK).for_each(|g| {
            for (o, v) in g.iter_mut().enumerate() {
                let scaled = strength * *v;
                *v = if o < 3 { exp(scaled) } else { scaled };
            }
        });
        ObjectGrades { affine: self.field.affine().map(|row| row.map(|v| strength * v)), grades }
    }

    /// The enhanced water of a view: `maps` are the frozen medium's, `camera` is the camera centre in the
    /// scene's frame. A field that was learnt in clear radiance leaves the water unchanged.
    pub fn water(&self, camera: [f32; 3], maps: MediumMaps, strength: f32) -> MediumMaps {
        if self.appearance == Appearance::Clear {
            return maps;
        }
        let mut maps = maps;
        self.kept_water.at_strength(strength).thin(&mut maps);
        let water = ViewWater::new(maps);
        let mut out = MediumMaps::zeros(0, 0);
        WaterPass::default().forward(&self.field, camera, &water, strength, &mut out);
        out
    }
}

impl ObjectGrades {
    /// Turns the stage-1 colours of a view into enhanced colours, in place. One colour per Gaussian.
    pub fn apply(&self, colors: &mut [[f32; 3]]) {
        assert_eq!(colors.len(), self.grades.len(), "one colour per Gaussian");
        let (level, affine) = (Level::new(), &self.affine);
        colors.par_chunks_mut(CHUNK).zip(self.grades.par_chunks(CHUNK)).for_each(|(colors, grades)| {
            dispatch!(level, simd => regrade(simd, affine, grades, colors));
        });
    }

    /// Gaussian `i`'s map as rows `(M | m)`: `c⁺ = M c + m`. It is used to bake the field into spherical
    /// harmonics.
    pub fn matrix(&self, i: usize) -> [[f32; 4]; 3] {
        let grade = self.grades[i];
        std::array::from_fn(|o| {
            let mut row = self.affine[o];
            row[o] += 1.0;
            let mut row = row.map(|v| grade[o] * v);
            row[3] += grade[3 + o];
            row
        })
    }
}

/// Runs inside a dispatched level, so that fused multiply-adds are instructions.
#[inline(always)]
fn regrade<S: Simd>(_: S, affine: &[[f32; 4]; 3], grades: &[[f32; OUTPUTS]], colors: &mut [[f32; 3]]) {
    for (c, grade) in colors.iter_mut().zip(grades) {
        let graded = apply_affine(affine, *c);
        *c = std::array::from_fn(|o| grade[o].mul_add(graded[o], grade[3 + o]));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::field::Shape;
    use crate::field_box::FieldBox;
    use use3d_numerics::random::{Purpose, Stream};

    fn trained(seed: u64) -> (Enhancement, Vec<[f32; 3]>, Vec<[f32; 3]>) {
        let draw = Stream::new(seed, Purpose::new("enhancement test"), 0);
        let mut field = Field::identity(Shape::default(), FieldBox::UNIT, seed).unwrap();
        for (i, p) in field.parameters.iter_mut().enumerate() {
            *p += 0.2 * draw.normal(i as u64) as f32;
        }
        let point = |i: u64| std::array::from_fn(|k| draw.uniform(10_000 + 3 * i + k as u64) as f32 - 0.5);
        let means: Vec<[f32; 3]> = (0..300).map(point).collect();
        let dc: Vec<[f32; 3]> = (300..600).map(point).collect();
        let mut pass = ObjectPass::new(&field, &means, dc.iter().copied());
        pass.forward(&field);
        let enhancement = Enhancement {
            centre: pass.mean,
            field,
            appearance: Appearance::Water,
            kept_water: KeptWater::ALL,
        };
        (enhancement, means, dc)
    }

    #[test]
    fn a_crop_keeps_its_colours() {
        let (e, means, dc) = trained(1);
        let base: Vec<[f32; 3]> = (0..300).map(|i| [0.1, 0.2 + i as f32 * 1e-3, 0.5]).collect();
        let mut whole = base.clone();
        e.objects(&means, dc.iter().copied(), 1.0).apply(&mut whole);
        let mut crop = base[100..200].to_vec();
        e.objects(&means[100..200], dc[100..200].iter().copied(), 1.0).apply(&mut crop);
        assert_eq!(whole[100..200], crop);
    }

    #[test]
    fn strength_zero_is_the_reconstruction_and_one_is_what_training_saw() {
        let (e, means, dc) = trained(2);
        let base: Vec<[f32; 3]> = (0..300).map(|i| [0.9, 0.003 * i as f32, 0.0]).collect();
        let mut zero = base.clone();
        e.objects(&means, dc.iter().copied(), 0.0).apply(&mut zero);
        assert_eq!(zero, base);
        let mut one = base.clone();
        e.objects(&means, dc.iter().copied(), 1.0).apply(&mut one);
        let mut pass = ObjectPass::new(&e.field, &means, dc.iter().copied());
        pass.forward(&e.field);
        let mut seen = Vec::new();
        pass.colors(&e.field, &base, &mut seen);
        for (a, b) in one.as_flattened().iter().zip(seen.as_flattened()) {
            assert!((a - b).abs() < 1e-6, "{a} {b}");
        }
        let mut maps = MediumMaps::zeros(5, 4);
        for (i, v) in maps.color.data_mut().iter_mut().enumerate() {
            *v = i as f32 / 60.0;
        }
        maps.attenuation.data_mut().fill(0.3);
        assert_eq!(e.water([0.1, 0.2, 0.3], maps.clone(), 0.0), maps);
        assert_ne!(e.water([0.1, 0.2, 0.3], maps.clone(), 1.0), maps);
        let clear = Enhancement { appearance: Appearance::Clear, ..e.clone() };
        assert_eq!(clear.water([0.1, 0.2, 0.3], maps.clone(), 1.0), maps, "it says nothing about the water");
        let thin = Enhancement { kept_water: KeptWater([0.5, 0.25, 1.0]), ..e.clone() };
        assert_eq!(thin.water([0.1, 0.2, 0.3], maps.clone(), 0.0), maps);
        let [whole, part] =
            [&e, &thin].map(|e| e.water([0.1, 0.2, 0.3], maps.clone(), 1.0).attenuation.pixel(1, 1));
        for (c, k) in [0.5, 0.25, 1.0].into_iter().enumerate() {
            assert!((part[c] - k * whole[c]).abs() < 1e-6, "channel {c}: {part:?}, {whole:?}");
        }
    }

    #[test]
    fn the_matrix_is_the_map() {
        let (e, means, dc) = trained(3);
        let objects = e.objects(&means, dc.iter().copied(), 0.7);
        let mut colors = vec![[0.2, 0.5, 0.8]; 300];
        objects.apply(&mut colors);
        for (i, c) in colors.iter().enumerate() {
            for (row, v) in objects.matrix(i).iter().zip(c) {
                let direct = row[0] * 0.2 + row[1] * 0.5 + row[2] * 0.8 + row[3];
                assert!((direct - v).abs() < 1e-5, "{direct} {v}");
            }
        }
    }
}
