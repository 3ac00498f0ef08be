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
//! USE3D_KILLS=100 USE3D_MACHINES=2 cargo test -p use3d --test killed_workers -- --nocapture
//! ```
//!
//! With `USE3D_MACHINES` the workers are on as many machines: none can check the processes of another one.

mod machines;
mod many;
mod tiny;

use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::time::{Duration, Instant};

use machines::{Fake, inside};
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

/// A worker on this machine, or on a fake one.
struct Worker<'m> {
    child: Child,
    machine: Option<&'m Fake>,
}

impl Worker<'_> {
    /// The number of its process outside and inside of its machine.
    fn process(&self) -> Option<(u32, u32)> {
        match self.machine {
            None => Some((self.child.id(), self.child.id())),
            Some(_) => inside(&self.child),
        }
    }

    /// Kills it; returns false if it had finished before.
    fn kill(&mut self) -> bool {
        if let Some((outer, _)) = self.process() {
            let _ = Command::new("kill").args(["-9", &outer.to_string()]).status();
        }
        !self.child.wait().expect("gone").success()
    }
}

/// The machines that `USE3D_MACHINES` asks for.
fn machines() -> Vec<Fake> {
    let count = std::env::var("USE3D_MACHINES").map_or(0, |n| n.parse().expect("a number of machines"));
    (1..=count).map(|n: usize| Fake::start(&format!("n{n}")).unwrap_or_else(|e| panic!("{e}"))).collect()
}

/// A cache on which workers are killed, and the expected results.
struct Target<'m> {
    many: &'m Many,
    machines: &'m [Fake],
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

    /// The file of the workers' messages.
    fn said(&self) -> PathBuf {
        self.many.at(&format!("said-{}", self.cache))
    }

    /// Fails, with the workers' messages, if one of them did not succeed.
    fn succeeds(&self, status: ExitStatus, kills: &BTreeMap<String, usize>) {
        let said = std::fs::read_to_string(self.said()).unwrap_or_default();
        assert!(status.success(), "{status} after {kills:?}: {said}");
    }

    /// Starts the n-th worker.
    fn worker(&self, n: usize) -> Worker<'_> {
        let mut command = self.many.command(&["-q", "run"], &self.cache);
        // A checkpoint after every step: a training that is interrupted anywhere resumes from the middle.
        command.args(["--set", "reconstruct.checkpoint_steps=1", "--set", "enhance.checkpoint_every=1"]);
        command.args(["--threads", "1", "--out"]).arg(self.many.at(&self.out()));
        let machine = self.machines.get(n % self.machines.len().max(1));
        if let Some(machine) = machine {
            command = machine.on(&command);
        }
        let said = File::options().create(true).append(true).open(self.said()).expect("a log");
        let child = command.stdout(Stdio::null()).stderr(said).spawn();
        Worker { child: child.expect("the command starts"), machine }
    }

    fn leases(&self) -> BTreeMap<PathBuf, Vec<u8>> {
        files(&self.many.at(&self.cache).join("v1/leases"))
    }

    /// The stage that a worker computes now; `None` while it only checks or waits.
    fn works_at(&self, worker: &Worker<'_>) -> Option<String> {
        let (_, pid) = worker.process()?;
        let is_holder = |bytes: &[u8]| {
            let line = bytes.split(|b| *b == b'\n').next().unwrap_or_default();
            let holder: serde_json::Value = serde_json::from_slice(line).unwrap_or_default();
            let here = worker.machine.is_none_or(|machine| holder["host"] == machine.name);
            here && holder["process"]["pid"].as_u64() == Some(pid.into())
        };
        // A lease has the name of its artifact, which lies in its stage's folder.
        let stage = |lease: &Path| {
            let artifact = self.whole.keys().find(|path| path.iter().nth(1) == Some(lease.as_os_str()))?;
            Some(artifact.iter().next()?.to_string_lossy().into_owned())
        };
        let own = self.leases().into_iter().filter(|(_, bytes)| is_holder(bytes));
        own.filter_map(|(path, _)| stage(&path)).next()
    }

    /// Kills workers one after the other until one of them finishes everything; then all may finish. Every
    /// artifact that exists at any time must have the expected bytes.
    fn campaign(&self, random: &mut Random, kills: &mut BTreeMap<String, usize>, enough: usize) {
        let mut workers: Vec<Worker<'_>> = (0..WORKERS).map(|n| self.worker(n)).collect();
        let total = |kills: &BTreeMap<String, usize>| kills.values().sum::<usize>();
        let mut ended = false;
        while !ended && total(kills) < enough {
            std::thread::sleep(Duration::from_millis(random.below(self.peace.as_millis().max(1) as u64)));
            for worker in &mut workers {
                if let Some(status) = worker.child.try_wait().expect("a state") {
                    self.succeeds(status, kills);
                    ended = true;
                }
            }
            let working: Vec<(usize, String)> = workers
                .iter()
                .enumerate()
                .filter_map(|(i, worker)| Some((i, self.works_at(worker)?)))
                .collect();
            if ended || working.is_empty() || self.many.artifacts(&self.cache).len() < self.from {
                continue;
            }
            let (unlucky, stage) = &working[random.below(working.len() as u64) as usize];
            if workers[*unlucky].kill() {
                *kills.entry(stage.clone()).or_default() += 1;
            }
            workers[*unlucky] = self.worker(*unlucky);
            for (path, bytes) in self.many.artifacts(&self.cache) {
                assert!(self.whole.get(&path) == Some(&bytes), "{} after {kills:?}", path.display());
            }
        }
        // A machine sweeps what was left by its own processes only, until enough time is over.
        let last = (0..self.machines.len()).map(|n| self.worker(n));
        for mut worker in workers.into_iter().chain(last) {
            let status = worker.child.wait().expect("ends");
            self.succeeds(status, kills);
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
    let (enough, machines) = (many_kills.unwrap_or(6), machines());
    let (mut random, mut kills) = (Random(0x2545_f491_4f6c_dd1d), BTreeMap::new());
    let (started, mut campaigns) = (Instant::now(), 0);
    while kills.values().sum::<usize>() < enough {
        // One campaign is enough for a few kills, except on a machine so busy that the moments are missed.
        assert!(campaigns < 10 + enough, "too few kills: {kills:?}");
        let cache = format!("cut{campaigns}");
        let from = if campaigns == 0 { 0 } else { random.below(whole.len() as u64) as usize };
        let target =
            Target { many: &many, machines: &machines, cache, whole: &whole, scores: &scores, peace, from };
        let so_far = kills.values().sum::<usize>();
        target.campaign(&mut random, &mut kills, enough.min(so_far + CAMPAIGN));
        campaigns += 1;
        for left in [&target.cache, &target.out()] {
            std::fs::remove_dir_all(many.at(left)).expect("removed");
        }
        println!("{campaigns} campaigns, {:.0} s: {kills:?}", started.elapsed().as_secs_f64());
    }
    println!(
        "{} kills of {WORKERS} workers on {} machines with one cache in {campaigns} campaigns, {:.0} s: {kills:?}",
        kills.values().sum::<usize>(),
        machines.len().max(1),
        started.elapsed().as_secs_f64()
    );
}

/// Starts a long training on a machine.
fn train<'m>(many: &Many, machine: &'m Fake) -> Worker<'m> {
    let mut command = many.command(&["-q", "run", "--cache-only", "--until-empty"], "cache");
    command.args(["--until", "reconstruct", "--set", "reconstruct.iterations=200000"]);
    let command = machine.on(&command).stdout(Stdio::null()).stderr(Stdio::null()).spawn();
    Worker { child: command.expect("the command starts"), machine: Some(machine) }
}

/// A machine is lost in the middle of a training, and nobody can ask a scheduler about it: another machine
/// goes on with the training, from its last checkpoint, within two minutes.
#[test]
fn the_training_of_a_lost_machine_goes_on_within_two_minutes() {
    let machines = machines();
    let [first, second, ..] = &machines[..] else {
        println!("SKIPPED, no machine was lost: set USE3D_MACHINES=2 to run it, as root on Linux");
        return;
    };
    let many = Many::new(&["a".to_string()]);
    let wait_for = |on: &str, word: &str, most: u64| {
        let host = format!("\"host\":\"{on}\"");
        let is_trained = |(path, bytes): (PathBuf, Vec<u8>)| {
            let text = String::from_utf8_lossy(&bytes).into_owned();
            !path.to_string_lossy().starts_with("run-") && text.contains(&host) && text.contains(word)
        };
        let start = Instant::now();
        while !files(&many.at("cache").join("v1/leases")).into_iter().any(is_trained) {
            assert!(start.elapsed() < Duration::from_secs(most), "{on} does not train after {most} s");
            std::thread::sleep(Duration::from_millis(20));
        }
        start.elapsed()
    };
    let mut lost = train(&many, first);
    // Its lease shows its progress.
    wait_for("n1", "steps", 60);
    let mut next = train(&many, second);
    // It has found the lease of the first one.
    std::thread::sleep(Duration::from_secs(4));
    assert!(lost.kill());
    let waited = wait_for("n2", "", 120);
    assert!(next.kill());
    println!("the training of a lost machine went on after {:.1} s", waited.as_secs_f64());
}
