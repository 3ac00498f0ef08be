//! Runs a batch through a real HyperQueue with two workers on this machine, with tasks killed at random; the
//! bytes are those of a run of one process.
//!
//! It needs the command `hq` on the path, or HyperQueue's Python package, and some minutes, so it runs only
//! on request:
//!
//! ```text
//! pip install hyperqueue
//! USE3D_HQ=1 USE3D_SCENES=use26 cargo test -p use3d --test hyperqueue -- --nocapture
//! ```

mod many;
mod tiny;

use std::fs;
use std::io::{BufRead, BufReader};
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use many::{Many, workers};

/// A server and two workers, which are ended when this value is dropped.
struct HyperQueue {
    path: String,
    server: PathBuf,
    running: Vec<Child>,
}

impl HyperQueue {
    /// Starts one, or prints the reason if it is not requested or not installed.
    fn asked(folder: &Path) -> Option<Self> {
        Self::start(folder)
            .inspect_err(|reason| println!("SKIPPED, nothing was tested with a real HyperQueue: {reason}"))
            .ok()
    }

    /// Starts one with its files below `folder`; the error is the reason if it is not requested or not
    /// installed.
    fn start(folder: &Path) -> Result<Self, String> {
        if std::env::var_os("USE3D_HQ").is_none() {
            return Err("set USE3D_HQ=1 to run it".to_string());
        }
        let path = std::env::var("PATH").unwrap_or_default();
        let server = folder.join("hq-server");
        let mut this = Self { path, server, running: Vec::new() };
        if Command::new("hq").arg("--version").output().is_ok() {
            this.spawn(&["server", "start"]);
            let start = Instant::now();
            while !this.hq(&["server", "info"]).output().is_ok_and(|o| o.status.success()) {
                assert!(start.elapsed() < Duration::from_secs(60), "the server does not answer");
                std::thread::sleep(Duration::from_millis(100));
            }
            for _ in 0..2 {
                this.spawn(&["worker", "start", "--cpus", "1"]);
            }
            return Ok(this);
        }
        let has_package = Command::new("python3").args(["-c", "import hyperqueue, tomllib"]).output();
        if !has_package.is_ok_and(|o| o.status.success()) {
            return Err(
                "neither `hq` nor HyperQueue's Python package is there: pip install hyperqueue".to_string()
            );
        }
        let bin = folder.join("hq-bin");
        fs::create_dir(&bin).expect("folder");
        let stand_in = bin.join("hq");
        let script = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/hyperqueue/hq.py");
        fs::write(&stand_in, format!("#!/bin/sh\nexec python3 '{script}' \"$@\"\n")).expect("written");
        fs::set_permissions(&stand_in, fs::Permissions::from_mode(0o755)).expect("executable");
        this.path = format!("{}:{}", bin.display(), this.path);
        fs::create_dir(&this.server).expect("folder");
        let mut child = this.hq(&["server", "start"]);
        let mut child = child.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().expect("python3 starts");
        let stdout = child.stdout.take().expect("its stdout");
        this.running.push(child);
        let (told, ready) = std::sync::mpsc::channel();
        // The output is read to its end, so that the server never writes into a closed pipe.
        std::thread::spawn(move || {
            BufReader::new(stdout).lines().map_while(Result::ok).filter(|line| line == "ready").for_each(
                |_| {
                    let _ = told.send(());
                },
            );
        });
        ready.recv_timeout(Duration::from_secs(60)).expect("the server is ready");
        Ok(this)
    }

    /// A command with the environment of this HyperQueue.
    fn with(&self, mut command: Command) -> Command {
        command.env("HQ_SERVER_DIR", &self.server).env("PATH", &self.path);
        command
    }

    fn hq(&self, words: &[&str]) -> Command {
        let mut command = self.with(Command::new("hq"));
        command.args(words);
        command
    }

    fn spawn(&mut self, words: &[&str]) {
        let child = self.hq(words).stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null()).spawn();
        self.running.push(child.expect("hq starts"));
    }
}

impl Drop for HyperQueue {
    fn drop(&mut self) {
        for mut child in self.running.drain(..) {
            let _ = child.kill();
            let _ = child.wait();
        }
    }
}

/// Submits the missing stages; returns the command's exit code, its output, and the job's number if there is
/// one.
fn submit(
    hyperqueue: &HyperQueue,
    many: &Many,
    cache: &str,
    layout: &str,
) -> (Option<i32>, String, Option<String>) {
    let mut submit = hyperqueue.with(many.command(&["submit", "hq"], cache));
    submit.args(["--cluster", "cluster.toml", "--layout", layout, "--out"]);
    let output = submit.arg(format!("out-{cache}")).output().expect("the command starts");
    let text =
        [output.stdout, output.stderr].map(|text| String::from_utf8_lossy(&text).into_owned()).concat();
    let id = text.lines().find_map(|line| line.strip_prefix("submitted ")?.split(" as job ").nth(1));
    let id = id.map(String::from);
    (output.status.code(), text, id)
}

/// `cluster.toml` for workers of one processor.
fn write_site(many: &Many) {
    let site =
        format!("command = \"{}\"\ncpus = 1\nat_once = 2\nmemory = \"900MB\"\n", env!("CARGO_BIN_EXE_use3d"));
    fs::write(many.at("cluster.toml"), site).expect("written");
}

/// One scene fails for good: the others are delivered all the same, and the output names the command for it
/// where a job of HyperQueue cannot deliver.
#[test]
fn a_scene_that_cannot_be_done_keeps_the_others_from_nothing() {
    let folder = tempfile::tempdir().expect("a folder");
    let Some(hyperqueue) = HyperQueue::asked(folder.path()) else { return };
    let many = Many::new(&["s1".to_string(), "s2".to_string()]);
    write_site(&many);
    let images = many.at("s2/images");
    for image in fs::read_dir(images).expect("images").flatten() {
        // The beginning and the end of the file, which plans read, are intact.
        let mut bytes = fs::read(image.path()).expect("an image");
        let middle = bytes.len() / 2;
        bytes[middle..middle + 8].iter_mut().for_each(|byte| *byte ^= 0xff);
        fs::write(image.path(), bytes).expect("damaged");
    }
    for layout in ["workers", "stages"] {
        let out = format!("out-{layout}");
        let (code, text, id) = submit(&hyperqueue, &many, layout, layout);
        assert_eq!(code, Some(0), "{text}");
        // Nothing is submitted while a job is not finished.
        let (code, again, _) = submit(&hyperqueue, &many, layout, layout);
        assert!(code == Some(2) && again.contains("still in the queue"), "{again}");
        let id = id.expect("a number");
        let mut wait = hyperqueue.hq(&["job", "wait", &id]);
        let _ = wait.stdout(Stdio::null()).stderr(Stdio::null()).status().expect("hq starts");
        let finished = many.at(&format!("{out}-submit/logs/finish-0.log")).exists();
        assert_eq!(finished, layout == "workers", "{text}");
        if layout == "stages" {
            assert!(text.contains("then run: use3d run ") && text.contains(" --keep-going"), "{text}");
            let mut run = many.command(&["run", "--keep-going", "--out", &out], layout);
            assert_eq!(run.output().expect("the command starts").status.code(), Some(1));
        }
        let said =
            fs::read_to_string(many.at(&format!("{out}-submit/logs/finish-0.err"))).unwrap_or_default();
        assert!(layout == "stages" || said.contains("1 stage is missing: s2"), "{said}");
        assert_eq!(many.scores(out.as_ref()).len(), 1, "{layout}: {text}{said}");
        println!("{layout}: the other scene was delivered");
    }
}

#[test]
fn a_batch_through_a_real_hyperqueue_ends_like_a_run_of_one_process() {
    let folder = tempfile::tempdir().expect("a folder");
    let Some(hyperqueue) = HyperQueue::asked(folder.path()) else { return };
    let many = Many::asked(3);
    let count = many.count;
    let whole = many.alone();
    write_site(&many);
    for layout in ["workers", "stages"] {
        let (start, mut rounds, mut kills) = (Instant::now(), 0, 0);
        // Repeated until there is nothing to submit: the same command repairs killed work.
        loop {
            rounds += 1;
            let (code, text, id) = submit(&hyperqueue, &many, layout, layout);
            assert_eq!(code, Some(0), "{text}");
            if text.contains("nothing to submit") {
                break;
            }
            assert!(rounds < 20, "{text}");
            let id = id.expect("a number");
            let mut wait = hyperqueue.hq(&["job", "wait", &id]);
            let mut wait = wait.stdout(Stdio::null()).stderr(Stdio::null()).spawn().expect("hq starts");
            let mut looks = 0;
            while wait.try_wait().expect("a state").is_none() {
                looks += 1;
                assert!(start.elapsed() < Duration::from_secs(3600), "{layout}: it does not end");
                std::thread::sleep(Duration::from_millis(500));
                let running = workers(&many.at(layout).to_string_lossy());
                // Early enough that a worker exists; any worker may be chosen.
                if let Some(pid) =
                    running.get(looks % running.len().max(1)).filter(|_| looks % 4 == 0 && kills < 4)
                {
                    let killed = Command::new("kill").args(["-9", &pid.to_string()]).status().expect("kill");
                    kills += usize::from(killed.success());
                }
            }
        }
        assert!(kills > 0, "{layout}: no task was killed, so that nothing was tested");
        let logs = || -> Vec<(PathBuf, String)> {
            let files = tiny::files(&many.at(&format!("out-{layout}-submit/logs")));
            files
                .into_iter()
                .map(|(path, text)| (path, String::from_utf8_lossy(&text).into_owned()))
                .collect()
        };
        let apart = Many::apart(&many.artifacts(layout), &whole);
        assert!(apart.is_empty(), "{layout}: other bytes than one process makes: {apart:?} {:?}", logs());
        assert_eq!(many.scores(format!("out-{layout}").as_ref()).len(), count, "{layout}: {:?}", logs());
        let seconds = start.elapsed().as_secs_f64();
        println!("{layout}: {count} scenes, {rounds} submissions, {seconds:.0} s, {kills} tasks killed");
    }
}
