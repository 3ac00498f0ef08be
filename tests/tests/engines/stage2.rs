//! Stage 2 on a second engine.

use std::collections::VecDeque;
use std::path::Path;

use use3d_atc::consensus::{LocalConsensus, Targets};
use use3d_atc::extractor::ExtractorSettings;
use use3d_atc::proposers::ProposerId;
use use3d_capture::{Appearance, KeptWater};
use use3d_enhance::engine::{
    Coverage, CpuFieldEngine, FieldEngine, FieldPlan, FieldReport, FieldState, Reading,
};
use use3d_enhance::{
    EnhanceError, EnhanceOutcome, EnhanceParams, EnhanceView, Guidance, Start, ViewErrors, enhance,
};
use use3d_reconstruct::engine::CpuEngine;
use use3d_scene::Scene;
use use3d_training::{Drain, EngineError, Observer, Silent};
use use3d_ubaf::OUTPUTS;

use crate::{UNDER_WAY, Watcher, bytes, lost, stage1};

/// An engine that delays its steps as long as possible and reports them late.
struct Late<'a> {
    inner: CpuFieldEngine<'a>,
    asked: VecDeque<(usize, FieldPlan)>,
    reports: Vec<FieldReport>,
    /// Number of steps until the device is lost.
    left: u64,
}

impl Late<'_> {
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

impl FieldEngine for Late<'_> {
    fn load(&mut self, state: FieldState) -> Result<(), EngineError> {
        self.asked.clear();
        self.reports.clear();
        self.inner.load(state)
    }

    fn save(&mut self) -> Result<FieldState, EngineError> {
        self.work(0)?;
        self.inner.save()
    }

    fn step(&mut self, view: usize, plan: &FieldPlan) -> Result<(), EngineError> {
        self.asked.push_back((view, *plan));
        self.work(UNDER_WAY)
    }

    fn drain(&mut self, which: Drain) -> Result<Vec<FieldReport>, EngineError> {
        if which == Drain::All {
            self.work(0)?;
        }
        Ok(std::mem::take(&mut self.reports))
    }

    fn evaluate(&mut self, view: usize, reading: Reading) -> Result<ViewErrors, EngineError> {
        self.work(0)?;
        self.inner.evaluate(view, reading)
    }

    fn centre(&mut self) -> Result<[f32; OUTPUTS], EngineError> {
        self.work(0)?;
        self.inner.centre()
    }

    fn coverage(&self) -> Coverage {
        self.inner.coverage()
    }
}

/// A trained scene, its training views, and targets without meaning.
fn problem() -> (Scene, Vec<EnhanceView>, Targets) {
    let scene = stage1::run(&mut CpuEngine::default(), None, &mut Silent).unwrap().scene;
    let views: Vec<EnhanceView> = stage1::capture().0.training_views().map(EnhanceView::from).collect();
    let n = scene.gaussians.len();
    let operator = std::array::from_fn(|i| 0.02 * (i as f64 - 5.0));
    let targets = Targets {
        extractor: ExtractorSettings::default(),
        proposer: ProposerId::default(),
        appearance: Appearance::Water,
        kept_water: KeptWater::ALL,
        scene: operator,
        dispersion: 0.0,
        global_scales: [0.2; 12],
        local_scales: [0.1; 6],
        views: views.iter().map(|view| (view.name.clone(), operator)).collect(),
        state: LocalConsensus {
            mean: (0..n).map(|i| [1e-3 * (i % 7) as f32; 6]).collect(),
            weight: vec![1.0; n],
            count: vec![3; n],
        },
    };
    (scene, views, targets)
}

fn params() -> EnhanceParams {
    EnhanceParams {
        iterations: 30,
        log_every: 7,
        checkpoint_every: 8,
        start: Start::Operator,
        ..EnhanceParams::default()
    }
}

#[test]
fn another_engine_trains_the_same_bytes_and_takes_over_from_one() {
    let (scene, views, targets) = problem();
    let (params, guidance) = (params(), Guidance::Targets(&targets));
    let cpu = || CpuFieldEngine::new(&scene, &views, guidance, &params, &mut Silent).unwrap();
    let late = |left| Late { inner: cpu(), asked: VecDeque::new(), reports: Vec::new(), left };
    let run = |engine: &mut dyn FieldEngine, dir: Option<&Path>, observer: &mut dyn Observer| {
        enhance(&scene, &views, guidance, &params, engine, dir, observer)
    };
    let same = |a: &EnhanceOutcome, b: &EnhanceOutcome| {
        assert_eq!(a.log_lines(), b.log_lines());
        assert_eq!(a.report, b.report);
        assert!(bytes(&a.scene) == bytes(&b.scene), "another enhancement");
    };
    let whole = run(&mut cpu(), None, &mut Silent).unwrap();
    assert_ne!(whole.log[0].loss, whole.log.last().unwrap().loss);
    same(&whole, &run(&mut late(u64::MAX), None, &mut Silent).unwrap());

    let dir = tempfile::tempdir().unwrap();
    let stopped = run(&mut late(u64::MAX), Some(dir.path()), &mut Watcher::new(5)).unwrap_err();
    assert!(matches!(stopped, EnhanceError::Interrupted { step: 5, saved: true, .. }), "{stopped}");
    // Eight steps later a checkpoint is written; the device is lost between that checkpoint and the next.
    let error = run(&mut late(12), Some(dir.path()), &mut Silent).unwrap_err();
    assert!(matches!(error, EnhanceError::Engine(EngineError::DeviceLost { .. })), "{error}");
    let mut watcher = Watcher::new(u64::MAX);
    same(&whole, &run(&mut cpu(), Some(dir.path()), &mut watcher).unwrap());
    assert!(watcher.notices.contains(&"resuming from step 13 of 30".to_string()), "{:?}", watcher.notices);
}
