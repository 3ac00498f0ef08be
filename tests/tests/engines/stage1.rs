//! Stage 1 on a second engine.

use std::borrow::Cow;
use std::collections::VecDeque;
use std::path::{Path, PathBuf};

use glam::DVec3;
use use3d_capture::{
    Camera, Capture, FileName, Frame, Image, Intrinsics, Map, Pixels, Pose, Raster, SparsePoint, Split, View,
};
use use3d_numerics::random::{Purpose, Stream};
use use3d_reconstruct::density::{self, Draws, Origin, Survey};
use use3d_reconstruct::engine::{
    CpuEngine, Degrees, Engine, Moments, Statistics, StepPlan, StepReport, TrainingState,
};
use use3d_reconstruct::{
    Exposure, Known, LoadedView, ReconstructError, ReconstructOutcome, ReconstructParams, TrainingView,
    reconstruct,
};
use use3d_training::{Drain, EngineError, Observer, Silent};

use crate::{UNDER_WAY, Watcher, bytes, lost};

/// An engine that delays its steps, reports them late, and has a state of its own between rebuilds.
struct Late {
    inner: CpuEngine,
    /// Number of bytes of stored pixels.
    pixels: usize,
    asked: VecDeque<(usize, StepPlan)>,
    reports: Vec<StepReport>,
    /// Number of steps until the device is lost.
    left: u64,
    /// Largest number of steps that were in progress.
    most: usize,
}

impl Late {
    fn new(left: u64) -> Self {
        let (asked, reports) = (VecDeque::new(), Vec::new());
        Self { inner: CpuEngine::default(), pixels: 0, asked, reports, left, most: 0 }
    }

    /// Does the requested steps until `keep` are left.
    fn work(&mut self, keep: usize) -> Result<(), EngineError> {
        while self.asked.len() > keep
            && let Some((view, plan)) = self.asked.pop_front()
        {
            self.left = self.left.checked_sub(1).ok_or_else(lost)?;
            self.inner.step(view, &plan)?;
            self.reports.extend(self.inner.drain(Drain::All)?);
        }
        Ok(())
    }
}

impl Engine for Late {
    fn upload(&mut self, view: TrainingView) -> Result<usize, EngineError> {
        // The data that a device would copy: pixels as they are stored, with masks and priors.
        let values = match &view.pixels {
            Pixels::Eight(raster) => raster.data().len(),
            Pixels::Sixteen(raster) => 2 * raster.data().len(),
        };
        let mask = view.mask.as_ref().map_or(0, |map| map.data().len());
        self.pixels += values + mask + view.prior.as_ref().map_or(0, |prior| 2 * prior.data().len());
        self.inner.upload(view)
    }

    fn load(&mut self, state: TrainingState) -> Result<(), EngineError> {
        self.asked.clear();
        self.reports.clear();
        self.inner.load(state)
    }

    fn save(&mut self) -> Result<Cow<'_, TrainingState>, EngineError> {
        self.work(0)?;
        Ok(Cow::Owned(self.inner.save()?.into_owned()))
    }

    fn step(&mut self, view: usize, plan: &StepPlan) -> Result<(), EngineError> {
        self.asked.push_back((view, plan.clone()));
        self.most = self.most.max(self.asked.len());
        self.work(UNDER_WAY)
    }

    fn drain(&mut self, which: Drain) -> Result<Vec<StepReport>, EngineError> {
        if which == Drain::All {
            self.work(0)?;
        }
        Ok(std::mem::take(&mut self.reports))
    }

    fn survey(&mut self) -> Result<Survey, EngineError> {
        let state = self.save()?;
        Ok(Survey::of(&state.gaussians, &state.statistics))
    }

    fn forget_statistics(&mut self) -> Result<(), EngineError> {
        let mut state = self.save()?.into_owned();
        state.statistics = Statistics::new(state.gaussians.len());
        self.inner.load(state)
    }

    fn rebuild(&mut self, rows: &[Origin], draws: &Draws) -> Result<(), EngineError> {
        let mut state = self.save()?.into_owned();
        let kept: Vec<usize> =
            rows.iter().take_while(|r| matches!(r, Origin::Kept(_))).map(|r| r.source()).collect();
        let gaussians = density::rebuilt(&state.gaussians, rows, draws);
        let mut moments = Moments::new(&gaussians);
        let of = |from: &use3d_splat::Gaussians, zeros: &use3d_splat::Gaussians| {
            let mut of_rows = from.select(&kept);
            of_rows.extend(&zeros.select(&(kept.len()..rows.len()).collect::<Vec<_>>()));
            of_rows
        };
        moments.first = of(&state.moments.first, &moments.first);
        moments.second = of(&state.moments.second, &moments.second);
        state.statistics = Statistics::new(gaussians.len());
        (state.gaussians, state.moments) = (gaussians, moments);
        // Reports of earlier steps are kept.
        self.inner.load(state)
    }

    fn limit_opacity(&mut self, ceiling: f64) -> Result<(), EngineError> {
        self.work(0)?;
        self.inner.limit_opacity(ceiling)
    }

    fn forget_water_moments(&mut self) -> Result<(), EngineError> {
        self.work(0)?;
        self.inner.forget_water_moments()
    }

    fn render(&mut self, camera: &Camera, degrees: Degrees, out: &mut Image) -> Result<(), EngineError> {
        self.work(0)?;
        self.inner.render(camera, degrees, out)
    }
}

/// Views of random colours over random points: the pictures have no meaning, but everything is computed.
pub(crate) fn capture() -> (Capture, Vec<LoadedView>) {
    let (width, height) = (56, 44);
    let stream = Stream::new(5, Purpose::new("a capture for two engines"), 0);
    let intrinsics = Intrinsics { width, height, fx: 50.0, fy: 50.0, cx: 28.0, cy: 22.0 };
    let mut loaded = Vec::new();
    let views: Vec<View> = (0..7)
        .map(|i| {
            let eye = DVec3::new(0.2 * f64::from(i) - 0.6, 0.1 * f64::from(i % 3), 0.0);
            let pose = Pose::look_at(eye, DVec3::new(0.0, 0.0, 2.0), -DVec3::Y);
            let draw = |k: usize| stream.uniform((10_000 * i as usize + k) as u64);
            let data = (0..3 * width * height).map(|k| (60.0 + 150.0 * draw(k)) as u8).collect();
            let prior = (0..width * height).map(|k| 0.3 + draw(5000 + k) as f32).collect();
            loaded.push(LoadedView {
                pixels: Pixels::Eight(Raster::from_planes(width, height, data).expect("three planes")),
                mask: None,
                depth_prior: Map::from_planes(width, height, prior),
            });
            View {
                name: FileName::new(&format!("{i}.png")).expect("a name"),
                id: i,
                image: PathBuf::new(),
                mask: None,
                depth_prior: None,
                camera: Camera { intrinsics, pose },
            }
        })
        .collect();
    let point = |i: u64| {
        let u = |k: u64| stream.uniform(1_000_000 + 8 * i + k);
        SparsePoint {
            position: DVec3::new(2.0 * u(0) - 1.0, 1.6 * u(1) - 0.8, 1.5 + u(2)),
            color: [u(3), u(4), u(5)].map(|c| (255.0 * c) as u8),
            error: 0.5,
            track_length: 3,
        }
    };
    let split = Split::every(views.len(), 4);
    let points = (0..120).map(point).collect();
    (Capture { name: "two".into(), views, split, points, frame: Frame::IDENTITY }, loaded)
}

fn params() -> ReconstructParams {
    let mut params = ReconstructParams {
        iterations: 40,
        log_every: 7,
        checkpoint_steps: 10,
        evaluate_every: 16,
        exposure: Exposure::PerView,
        ..ReconstructParams::default()
    };
    params.resolution_schedule = vec![(0.0, 2), (0.3, 1)];
    params.densify.statistics_from = 0;
    params.densify.warm_up = 6;
    params.densify.gentle_below = 0;
    params.densify.every = 5;
    params.densify.period = 20;
    params.densify.pause = 6;
    params.densify.cull_opacity = 0.05;
    params.densify.gradient_threshold = 2e-4;
    params.densify.reference_pixels = 0;
    params
}

pub(crate) fn run(
    engine: &mut dyn Engine,
    dir: Option<&Path>,
    observer: &mut dyn Observer,
) -> Result<ReconstructOutcome, ReconstructError> {
    let (capture, loaded) = capture();
    let load = |view: &View| Ok(loaded[view.id as usize].clone());
    reconstruct(&capture, &Known::default(), &load, &params(), engine, dir, observer)
}

fn same(a: &ReconstructOutcome, b: &ReconstructOutcome) {
    assert_eq!(a.log_lines(), b.log_lines());
    assert_eq!(a.evaluation, b.evaluation);
    assert_eq!(a.exposures, b.exposures);
    assert!(bytes(&a.scene) == bytes(&b.scene), "another scene");
}

#[test]
fn another_engine_trains_the_same_bytes() {
    let cpu = run(&mut CpuEngine::default(), None, &mut Silent).unwrap();
    assert!(cpu.log_lines().contains("\"event\":\"refine\"") && cpu.log_lines().contains("ceiling"));
    assert_ne!(cpu.scene.gaussians.len(), cpu.initial_gaussians);
    let mut late = Late::new(u64::MAX);
    same(&cpu, &run(&mut late, None, &mut Silent).unwrap());
    assert_eq!((late.most, late.pixels), (UNDER_WAY + 1, 5 * 56 * 44 * (3 + 2)));
    // An engine that is already in use would mix up its views.
    let again = run(&mut late, None, &mut Silent).unwrap_err();
    assert!(again.to_string().contains("in use already"), "{again}");
}

#[test]
fn a_run_goes_on_with_another_engine_where_one_was_stopped_or_lost() {
    let whole = run(&mut CpuEngine::default(), None, &mut Silent).unwrap();
    let dir = tempfile::tempdir().unwrap();
    let stopped = run(&mut CpuEngine::default(), Some(dir.path()), &mut Watcher::new(13)).unwrap_err();
    assert!(matches!(stopped, ReconstructError::Interrupted { step: 13, saved: true, .. }), "{stopped}");
    // Ten steps later a checkpoint is written; the device is lost between that checkpoint and the next.
    let mut told = Watcher::new(u64::MAX);
    let error = run(&mut Late::new(15), Some(dir.path()), &mut told).unwrap_err();
    assert!(matches!(error, ReconstructError::Engine(EngineError::DeviceLost { .. })), "{error}");
    assert!(error.to_string().contains("unplugged"), "{error}");
    let kept = "the checkpoint of step 23 is kept; run the same command to continue from there";
    assert_eq!(told.notices.last().map(String::as_str), Some(kept));
    let mut watcher = Watcher::new(u64::MAX);
    same(&whole, &run(&mut CpuEngine::default(), Some(dir.path()), &mut watcher).unwrap());
    assert!(watcher.notices.contains(&"resuming from step 23 of 40".to_string()), "{:?}", watcher.notices);
}
