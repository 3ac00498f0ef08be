//! The real stages are killed again and again: the files left are complete at every moment, trainings resume
//! from the middle, and the result is that of an undisturbed run, to the byte.
//!
//! The test aims its kills at stages, by checking which logs and checkpoints appear, so that every stage is
//! hit on slow machines and quick ones. The normal run has a few of each; for many, and the figures:
//!
//! ```text
//! USE3D_KILLS=100 cargo test -p use3d --test kills -- --nocapture
//! ```
//!
//! A second test lets `strace` kill the runs at system calls that change files, in the middle of a stage.

mod tiny;

use std::collections::{BTreeMap, BTreeSet};
use std::os::unix::process::{CommandExt, ExitStatusExt};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::time::{Duration, Instant};

use tiny::{Place, files};

const STAGES: [&str; 9] =
    ["import", "pairs", "calibrate", "reconstruct", "targets", "enhance", "render", "evaluate", "report"];
const TRAININGS: [&str; 2] = ["reconstruct", "enhance"];
/// Steps of each training, with a checkpoint after every step.
const STEPS: u64 = 80;
const OFTEN: [&str; 5] = [
    "reconstruct.iterations=80",
    "reconstruct.checkpoint_steps=1",
    "enhance.iterations=80",
    "enhance.checkpoint_every=1",
    // The default's estimate of the water is killed too.
    "reconstruct.medium_prior=auto",
];

/// Marsaglia's xorshift: the same moments in every run, as far as the clock allows.
struct Random(u64);

impl Random {
    fn below(&mut self, end: u64) -> u64 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        self.0 % end
    }
}

#[derive(Debug, Default)]
struct Tally {
    kills: BTreeMap<&'static str, usize>,
    /// Number of times that a training resumed from one of its own steps.
    inside: BTreeMap<&'static str, usize>,
}

/// A cache on which runs are killed.
struct Target<'p> {
    place: &'p Place,
    cache: String,
}

impl Target<'_> {
    fn out(&self) -> String {
        format!("out-{}", self.cache)
    }

    fn run(&self, sets: &[&str]) -> Command {
        self.place.run_into(&self.out(), "tiny", &self.cache, sets)
    }

    fn spawn(&self) -> Child {
        self.run(&OFTEN).stdout(Stdio::null()).stderr(Stdio::null()).spawn().expect("the command starts")
    }

    fn below(&self, path: &str) -> PathBuf {
        Path::new(&self.place.at(&self.cache)).join("v1").join(path)
    }

    /// The logs of the stages that have started.
    fn logs(&self) -> BTreeMap<&'static str, String> {
        let logs = files(&self.below("logs"));
        let of = |stage: &&'static str| {
            let (_, bytes) = logs.iter().find(|(path, _)| path.ends_with(format!("{stage}.log")))?;
            Some((*stage, String::from_utf8_lossy(bytes).into_owned()))
        };
        STAGES.iter().filter_map(of).collect()
    }

    fn checkpoints(&self, stage: &str) -> BTreeSet<PathBuf> {
        let folders =
            std::fs::read_dir(self.below("checkpoints").join(stage)).into_iter().flatten().flatten();
        let inside =
            folders.flat_map(|folder| std::fs::read_dir(folder.path()).into_iter().flatten().flatten());
        inside.map(|e| e.path()).filter(|p| p.extension().is_some_and(|e| e == "checkpoint")).collect()
    }

    fn is_made(&self, stage: &str) -> bool {
        std::fs::read_dir(self.below("artifacts").join(stage)).is_ok_and(|mut list| list.next().is_some())
    }

    /// All files of artifacts except their manifests, which contain times and hosts.
    fn artifacts(&self) -> BTreeMap<PathBuf, Vec<u8>> {
        let mut all = files(&self.below("artifacts"));
        all.retain(|path, _| !path.ends_with("manifest.json"));
        all
    }

    /// The delivered results of the scene.
    fn results(&self) -> BTreeMap<PathBuf, Vec<u8>> {
        let mut all = files(&Path::new(&self.place.at(&self.out())).join("tiny"));
        all.retain(|path, _| !path.ends_with("manifest.json"));
        all
    }

    /// Starts a run and kills it in the first stage that still needs kills; a training is killed after the
    /// checkpoint of another step. Returns false if the run finished. Stages are caught in any order, which
    /// the engine chooses.
    fn kill_once(
        &self,
        left: &mut BTreeMap<&'static str, usize>,
        random: &mut Random,
        tally: &mut Tally,
    ) -> bool {
        let _ = std::fs::remove_dir_all(self.below("logs"));
        let before = TRAININGS.map(|training| (training, self.checkpoints(training)));
        let mut child = self.spawn();
        let works = |stage: &str| {
            let safe = before.iter().find(|(training, _)| *training == stage);
            !self.is_made(stage)
                && safe.is_none_or(|(_, old)| self.checkpoints(stage).difference(old).count() > 0)
        };
        let stage = loop {
            let started = self.logs();
            if let Some(stage) = started.keys().copied().find(|stage| left[stage] > 0 && works(stage)) {
                break stage;
            }
            if let Some(status) = child.try_wait().expect("a state") {
                assert!(status.success(), "{status} with {left:?} to come");
                return false;
            }
            std::thread::sleep(Duration::from_millis(1));
        };
        std::thread::sleep(Duration::from_millis(random.below(25)));
        let caught = child.try_wait().expect("a state").is_none();
        child.kill().expect("killed");
        child.wait().expect("gone");
        left.entry(stage).and_modify(|n| *n -= 1);
        *tally.kills.entry(stage).or_default() += usize::from(caught);
        let logs = self.logs();
        let step = logs.get(stage).and_then(|log| log.split("resuming from step ").nth(1)).and_then(|rest| {
            rest.split(|c: char| !c.is_ascii_digit()).next().and_then(|number| number.parse::<u64>().ok())
        });
        if step.is_some_and(|step| 0 < step && step < STEPS) {
            *tally.inside.entry(stage).or_default() += 1;
        }
        true
    }
}

/// Kills a run again and again, `trainings` and `others` times in each stage, then lets it finish.
fn campaign(
    target: &Target<'_>,
    (trainings, others): (usize, usize),
    whole: &Target<'_>,
    random: &mut Random,
    tally: &mut Tally,
) {
    let expected = whole.artifacts();
    let kills = |stage| if TRAININGS.contains(&stage) { trainings } else { others };
    let mut left: BTreeMap<&'static str, usize> = STAGES.into_iter().map(|s| (s, kills(s))).collect();
    while target.kill_once(&mut left, random, tally) {
        for (path, bytes) in target.artifacts() {
            assert!(expected.get(&path) == Some(&bytes), "{} after {tally:?}", path.display());
        }
    }
    let last = target.run(&OFTEN).output().expect("runs");
    assert!(last.status.success(), "{}", String::from_utf8_lossy(&last.stderr));
    let found = target.artifacts();
    assert_eq!(found.keys().collect::<Vec<_>>(), expected.keys().collect::<Vec<_>>());
    assert!(found == expected, "some artifact differs");
    assert!(target.results() == whole.results(), "some result differs");
    for leftover in ["tmp", "leases"] {
        assert_eq!(files(&target.below(leftover)).len(), 0, "{leftover} is swept");
    }
}

#[test]
fn killed_at_any_moment_the_artifacts_are_those_of_an_undisturbed_run() {
    let place = Place::new();
    let target = |cache: String| Target { place: &place, cache };
    let whole = target("whole".to_string());
    let undisturbed = whole.run(&OFTEN).output().expect("runs");
    assert!(undisturbed.status.success(), "{}", String::from_utf8_lossy(&undisturbed.stderr));
    assert!(whole.artifacts().len() > 20 && whole.results().len() > 10, "{} files", whole.artifacts().len());

    let many: Option<usize> =
        std::env::var("USE3D_KILLS").ok().map(|n| n.parse().expect("a number of kills"));
    let (kills, inside) = many.map_or((7, 1), |kills| (kills, 5));
    let (mut random, mut tally) = (Random(0x2545_f491_4f6c_dd1d), Tally::default());
    let started = Instant::now();
    let mut campaigns = 0;
    let enough = |tally: &Tally| {
        tally.kills.values().sum::<usize>() >= kills
            && TRAININGS.iter().all(|t| tally.inside.get(t).is_some_and(|n| *n >= inside))
    };
    // One campaign is enough, except on a machine so busy that the moments are missed.
    while !enough(&tally) {
        assert!(campaigns < 3 + kills / 5, "too few kills: {tally:?}");
        let often = if many.is_some() { (5, 2) } else { (3, 1) };
        campaign(&target(format!("cut{campaigns}")), often, &whole, &mut random, &mut tally);
        campaigns += 1;
    }
    println!(
        "{} kills in {campaigns} campaigns, {:.0} s: {:?}; gone on from inside: {:?}",
        tally.kills.values().sum::<usize>(),
        started.elapsed().as_secs_f64(),
        tally.kills,
        tally.inside
    );
}

/// The system calls at which runs are killed, with the first and the last number of a call that counts. A
/// program makes many calls of some kinds before its first stage, and few of other kinds in all.
const CALLS: [(&str, u64, u64); 8] = [
    ("rename", 1, 40),
    ("fsync", 1, 80),
    ("mkdir", 1, 4),
    ("openat", 30, 110),
    ("write", 1, 80),
    ("unlink", 1, 6),
    ("rmdir", 1, 2),
    ("close", 30, 110),
];

/// Ends a run by `strace` at the `n`-th call of a kind that one of its threads makes.
fn killed_at(target: &Target<'_>, call: &str, n: u64) -> ExitStatus {
    let run = target.run(&OFTEN);
    let mut strace = Command::new("strace");
    strace.args(["-f", "-qqq", "-o", "/dev/null", "-e", &format!("trace={call}")]);
    strace.args(["-e", &format!("inject={call}:signal=SIGKILL:when={n}"), "--"]).arg(run.get_program());
    strace.args(run.get_args()).env_remove("USE3D_CACHE").env_remove("USE3D_MODELS");
    strace.stdout(Stdio::null()).stderr(Stdio::null()).stdin(Stdio::null());
    // When its processes are killed, strace may stop its whole group.
    let mut child = strace.process_group(0).spawn().expect("strace starts");
    let group = format!("-{}", child.id());
    loop {
        for _ in 0..100 {
            if let Some(status) = child.try_wait().expect("a state") {
                return status;
            }
            std::thread::sleep(Duration::from_millis(10));
        }
        let _ = Command::new("kill").args(["-CONT", "--", &group]).stderr(Stdio::null()).status();
    }
}

/// The stage in which a process was killed, from the lease that it left. `before` has the leases of earlier
/// processes.
fn interrupted(
    target: &Target<'_>,
    before: &BTreeMap<PathBuf, Vec<u8>>,
    expected: &BTreeMap<PathBuf, Vec<u8>>,
) -> Option<String> {
    let mut left = files(&target.below("leases"));
    left.retain(|path, bytes| before.get(path) != Some(bytes));
    // A lease has the name of its artifact, which lies in its stage's folder.
    let artifact = expected.keys().find(|path| {
        let key = path.iter().nth(1);
        key.is_some_and(|key| left.contains_key(Path::new(key)))
    })?;
    Some(artifact.iter().next()?.to_string_lossy().into_owned())
}

#[test]
fn killed_at_any_system_call_the_artifacts_are_those_of_an_undisturbed_run() {
    let works = ["-qqq", "-o", "/dev/null", "-e", "inject=getpid:signal=SIGKILL:when=9", "true"];
    if !Command::new("strace").args(works).output().is_ok_and(|o| o.status.success()) {
        println!("SKIPPED, no run was killed at a system call: strace is not installed, or forbidden");
        return;
    }
    let many: Option<usize> =
        std::env::var("USE3D_KILLS").ok().map(|n| n.parse().expect("a number of kills"));
    let enough = many.unwrap_or(4);
    let place = Place::new();
    let whole = Target { place: &place, cache: "whole".to_string() };
    let undisturbed = whole.run(&OFTEN).output().expect("runs");
    assert!(undisturbed.status.success(), "{}", String::from_utf8_lossy(&undisturbed.stderr));
    let expected = whole.artifacts();
    let mut random = Random(0x2545_f491_4f6c_dd1d);
    let (mut stages, mut calls) = (BTreeMap::<String, usize>::new(), BTreeMap::<&str, usize>::new());
    let (started, mut campaigns, mut outside) = (Instant::now(), 0, 0);
    // Only kills in the middle of a stage count.
    while stages.values().sum::<usize>() < enough {
        assert!(campaigns < 3 + enough, "too few kills: {stages:?}");
        let target = Target { place: &place, cache: format!("call{campaigns}") };
        campaigns += 1;
        loop {
            let (call, first, last) = CALLS[random.below(CALLS.len() as u64) as usize];
            let n = first + random.below(last - first + 1);
            let before = files(&target.below("leases"));
            let status = killed_at(&target, call, n);
            let found = target.artifacts();
            for (path, bytes) in &found {
                assert!(expected.get(path) == Some(bytes), "{} after {call} {n}", path.display());
            }
            if status.success() {
                break;
            }
            assert_eq!(status.signal(), Some(9), "{call} {n}: {status}");
            match interrupted(&target, &before, &expected) {
                Some(stage) => {
                    *stages.entry(stage).or_default() += 1;
                    *calls.entry(call).or_default() += 1;
                }
                None => outside += 1,
            }
            if stages.values().sum::<usize>() >= enough {
                break;
            }
        }
        let last = target.run(&OFTEN).output().expect("runs");
        assert!(last.status.success(), "{}", String::from_utf8_lossy(&last.stderr));
        assert!(target.artifacts() == expected, "some artifact differs after {calls:?}");
        assert!(target.results() == whole.results(), "some result differs after {calls:?}");
        for leftover in ["tmp", "leases"] {
            assert_eq!(files(&target.below(leftover)).len(), 0, "{leftover} is swept");
        }
        for folder in [&target.cache, &target.out()] {
            std::fs::remove_dir_all(place.at(folder)).expect("removed");
        }
        println!("{campaigns} campaigns, {:.0} s: {stages:?}", started.elapsed().as_secs_f64());
    }
    println!(
        "{} kills in stages and {outside} outside, in {campaigns} campaigns, {:.0} s: {stages:?} {calls:?}",
        stages.values().sum::<usize>(),
        started.elapsed().as_secs_f64()
    );
}

#[test]
fn runs_of_two_lengths_with_one_cache_and_one_folder_for_results_end_both() {
    let place = Place::new();
    let ends = |iterations: [u64; 2], cache: &str| {
        let children: Vec<Child> = iterations
            .iter()
            .map(|n| {
                let sets =
                    [format!("reconstruct.iterations={n}"), "reconstruct.checkpoint_steps=1".to_string()];
                let out = format!("out-{cache}");
                let mut command = place.run_into(&out, "tiny", cache, &[&sets[0], &sets[1]]);
                command.args(["--until", "reconstruct"]);
                command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().expect("the command starts")
            })
            .collect();
        for child in children {
            let output = child.wait_with_output().expect("ends");
            assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stdout));
        }
        let target = Target { place: &place, cache: cache.to_string() };
        (target.artifacts(), target.checkpoints("reconstruct").len(), target.results())
    };
    let (found, checkpoints, delivered) = ends([40, 45], "shared");
    // Both delivered into one folder: it holds one of the two scenes, complete.
    let scenes: BTreeSet<&Path> = found
        .keys()
        .filter(|path| path.starts_with("reconstruct"))
        .filter_map(|path| path.parent())
        .collect();
    let is_delivered = |scene: &&&Path| {
        let own = found.iter().filter_map(|(path, bytes)| Some((path.strip_prefix(scene).ok()?, bytes)));
        own.clone().count() > 4
            && own
                .into_iter()
                .all(|(path, bytes)| delivered.get(&Path::new("scene").join(path)) == Some(bytes))
    };
    assert_eq!(scenes.iter().filter(is_delivered).count(), 1, "{:?}", delivered.keys());
    assert_eq!(checkpoints, 2, "each keeps its last");
    // One run after the other gives the same.
    let target = Target { place: &place, cache: "alone".to_string() };
    for n in ["reconstruct.iterations=45", "reconstruct.iterations=40"] {
        let output = target
            .run(&[n, "reconstruct.checkpoint_steps=1"])
            .args(["--until", "reconstruct"])
            .output()
            .expect("runs");
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    }
    assert!(found == target.artifacts(), "some artifact differs");
}
