//! Workers that share a cache are killed at random moments and started again: whenever that happens, nothing
//! is lost, and the result is that of one undisturbed process, to the byte.
//!
//! While `kills` aims at stages one after the other, this test aims at interactions of several processes:
//! leases of ended holders, work put back and taken again, names published twice, results delivered by two.
//! Only kills of a worker that held a lease count, so each of them interrupted a stage. The normal run has a
//! few; for many, and the figures:
//!
//! ```text
//! USE3D_KILLS=1000 cargo test -p use3d --test killed_workers -- --nocapture
//! ```

mod many;
mod tiny;

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::process::{Child, Stdio};
use std::time::{Duration, Instant};

use many::Many;
use tiny::files;

/// Number of workers at the same time.
const WORKERS: usize = 3;
/// The longest time between two kills, as a share of the time that one process takes for everything. With it
/// the workers make progress, and every stage is hit, on quick machines and on slow ones.
const PEACE: u32 = 24;
/// Number of kills after which the runs on a cache may finish and are compared.
const CAMPAIGN: usize = 50;

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

/// A cache on which workers are killed, and the expected results.
struct Target<'m> {
    many: &'m Many,
    cache: String,
    whole: &'m BTreeMap<PathBuf, Vec<u8>>,
    scores: &'m BTreeMap<PathBuf, Vec<u8>>,
    peace: Duration,
    /// Number of artifact files that exist before the first kill: a campaign that always began with nothing
    /// would spend its kills on the first stages.
    from: usize,
}

impl Target<'_> {
    fn out(&self) -> String {
        format!("out-{}", self.cache)
    }

    fn worker(&self) -> Child {
        let mut command = self.many.command(&["-q", "run"], &self.cache);
        // A checkpoint after every step: a training that is interrupted anywhere resumes from the middle.
        command.args(["--set", "reconstruct.checkpoint_steps=1", "--set", "enhance.checkpoint_every=1"]);
        command.args(["--threads", "1", "--out"]).arg(self.many.at(&self.out()));
        command.stdout(Stdio::null()).stderr(Stdio::null()).spawn().expect("the command starts")
    }

    fn leases(&self) -> BTreeMap<PathBuf, Vec<u8>> {
        files(&self.many.at(&self.cache).join("v1/leases"))
    }

    /// The stage that a process computes now; `None` while it only checks or waits.
    fn works_at(&self, pid: u32) -> Option<String> {
        let holder = |bytes: &[u8]| {
            let line = bytes.split(|b| *b == b'\n').next()?;
            serde_json::from_slice::<serde_json::Value>(line).ok()?["process"]["pid"].as_u64()
        };
        // A lease has the name of its artifact, which lies in its stage's folder.
        let stage = |lease: &Path| {
            let artifact = self.whole.keys().find(|path| path.iter().nth(1) == Some(lease.as_os_str()))?;
            Some(artifact.iter().next()?.to_string_lossy().into_owned())
        };
        let own = self.leases().into_iter().filter(|(_, bytes)| holder(bytes) == Some(pid.into()));
        own.filter_map(|(path, _)| stage(&path)).next()
    }

    /// Kills workers one after the other until one of them finishes everything; then all may finish. Every
    /// artifact that exists at any time must have the expected bytes.
    fn campaign(&self, random: &mut Random, kills: &mut BTreeMap<String, usize>, enough: usize) {
        let mut workers: Vec<Child> = (0..WORKERS).map(|_| self.worker()).collect();
        let total = |kills: &BTreeMap<String, usize>| kills.values().sum::<usize>();
        let mut ended = false;
        while !ended && total(kills) < enough {
            std::thread::sleep(Duration::from_millis(random.below(self.peace.as_millis().max(1) as u64)));
            for worker in &mut workers {
                if let Some(status) = worker.try_wait().expect("a state") {
                    assert!(status.success(), "{status} after {kills:?}");
                    ended = true;
                }
            }
            let working: Vec<(usize, String)> = workers
                .iter()
                .enumerate()
                .filter_map(|(i, worker)| Some((i, self.works_at(worker.id())?)))
                .collect();
            if ended || working.is_empty() || self.many.artifacts(&self.cache).len() < self.from {
                continue;
            }
            let (unlucky, stage) = &working[random.below(working.len() as u64) as usize];
            let unlucky = &mut workers[*unlucky];
            unlucky.kill().expect("killed");
            if !unlucky.wait().expect("gone").success() {
                *kills.entry(stage.clone()).or_default() += 1;
            }
            *unlucky = self.worker();
            for (path, bytes) in self.many.artifacts(&self.cache) {
                assert!(self.whole.get(&path) == Some(&bytes), "{} after {kills:?}", path.display());
            }
        }
        for mut worker in workers {
            let status = worker.wait().expect("ends");
            assert!(status.success(), "{status} after {kills:?}");
        }
        let found = self.many.artifacts(&self.cache);
        assert_eq!(found.keys().collect::<BTreeSet<_>>(), self.whole.keys().collect(), "after {kills:?}");
        assert!(found == *self.whole, "some artifact differs after {kills:?}");
        assert!(self.many.scores(self.out().as_ref()) == *self.scores, "some score differs after {kills:?}");
        let tmp = files(&self.many.at(&self.cache).join("v1/tmp"));
        assert!(tmp.is_empty() && self.leases().is_empty(), "{:?} {:?} are swept", tmp.keys(), self.leases());
    }
}

#[test]
fn workers_that_are_killed_at_random_lose_nothing() {
    let many_kills: Option<usize> =
        std::env::var("USE3D_KILLS").ok().map(|n| n.parse().expect("a number of kills"));
    let names =
        if many_kills.is_some() { vec!["a".to_string(), "b".to_string()] } else { vec!["a".to_string()] };
    let many = Many::new(&names);
    let started = Instant::now();
    let whole = many.alone();
    let peace = started.elapsed() / PEACE;
    let scores = many.scores("out-alone".as_ref());
    assert!(whole.len() > 20 && scores.len() == names.len(), "{} files", whole.len());
    let enough = many_kills.unwrap_or(6);
    let (mut random, mut kills) = (Random(0x2545_f491_4f6c_dd1d), BTreeMap::new());
    let (started, mut campaigns) = (Instant::now(), 0);
    while kills.values().sum::<usize>() < enough {
        // One campaign is enough for a few kills, except on a machine so busy that the moments are missed.
        assert!(campaigns < 10 + enough, "too few kills: {kills:?}");
        let cache = format!("cut{campaigns}");
        let from = if campaigns == 0 { 0 } else { random.below(whole.len() as u64) as usize };
        let target = Target { many: &many, cache, whole: &whole, scores: &scores, peace, from };
        let so_far = kills.values().sum::<usize>();
        target.campaign(&mut random, &mut kills, enough.min(so_far + CAMPAIGN));
        campaigns += 1;
        for left in [&target.cache, &target.out()] {
            std::fs::remove_dir_all(many.at(left)).expect("removed");
        }
        println!("{campaigns} campaigns, {:.0} s: {kills:?}", started.elapsed().as_secs_f64());
    }
    println!(
        "{} kills of {WORKERS} workers on one cache in {campaigns} campaigns, {:.0} s: {kills:?}",
        kills.values().sum::<usize>(),
        started.elapsed().as_secs_f64()
    );
}
