//! A batch through a real HyperQueue with two workers on this machine, tasks killed at random; the bytes are
//! those of a run of one process.
//!
//! Needs the command `hq` on the path, or HyperQueue's Python package, and some minutes, so it is asked for:
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

/// A server and two workers. They end with it.
struct HyperQueue {
    path: String,
    server: PathBuf,
    running: Vec<Child>,
}

impl HyperQueue {
    /// Starts one with its files below `folder`; why not, where it is not asked for or not there.
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
        // Read to its end, so that the server never writes into a closed pipe.
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

    /// A command that sees this HyperQueue.
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

#[test]
fn a_batch_through_a_real_hyperqueue_ends_like_a_run_of_one_process() {
    let folder = tempfile::tempdir().expect("a folder");
    let hyperqueue = match HyperQueue::start(folder.path()) {
        Ok(started) => started,
        Err(reason) => {
            println!("SKIPPED, nothing was tested with a real HyperQueue: {reason}");
            return;
        }
    };
    let many = Many::asked(3);
    let count = many.count;
    let whole = many.alone();
    let site = format!("command = \"{}\"\ncpus = 1\nat_once = 2\n", env!("CARGO_BIN_EXE_use3d"));
    fs::write(many.at("cluster.toml"), site).expect("written");
    for layout in ["workers", "stages"] {
        let (start, mut rounds, mut kills) = (Instant::now(), 0, 0);
        // Again, until there is nothing to submit: what was killed is repaired by the same command.
        loop {
            rounds += 1;
            let mut submit = hyperqueue.with(many.command(&["submit", "hq"], layout));
            submit.args(["--cluster", "cluster.toml", "--layout", layout, "--out"]);
            let output = submit.arg(format!("out-{layout}")).output().expect("the command starts");
            let text = String::from_utf8_lossy(&output.stdout).into_owned();
            assert!(output.status.success(), "{text}{}", String::from_utf8_lossy(&output.stderr));
            if text.contains("nothing to submit") {
                break;
            }
            assert!(rounds < 20, "{text}");
            let id = text.lines().find_map(|line| line.split("job ID: ").nth(1)).expect("a number");
            let mut wait = hyperqueue.hq(&["job", "wait", id.trim()]);
            let mut wait = wait.stdout(Stdio::null()).stderr(Stdio::null()).spawn().expect("hq starts");
            let mut looks = 0;
            while wait.try_wait().expect("a state").is_none() {
                looks += 1;
                assert!(start.elapsed() < Duration::from_secs(3600), "{layout}: it does not end");
                std::thread::sleep(Duration::from_millis(500));
                let running = workers(&many.at(layout).to_string_lossy());
                if let Some(pid) = running.get(looks % 2).filter(|_| looks % 8 == 0 && rounds < 3) {
                    let killed = Command::new("kill").args(["-9", &pid.to_string()]).status().expect("kill");
                    kills += usize::from(killed.success());
                }
            }
        }
        let logs = || -> Vec<(PathBuf, String)> {
            let files = tiny::files(&many.at(&format!("out-{layout}-submit/logs")));
            files
                .into_iter()
                .map(|(path, text)| (path, String::from_utf8_lossy(&text).into_owned()))
                .collect()
        };
        assert!(
            many.artifacts(layout) == whole,
            "{layout}: other bytes than one process makes: {:?}",
            logs()
        );
        assert_eq!(many.scores(format!("out-{layout}").as_ref()).len(), count, "{layout}: {:?}", logs());
        let seconds = start.elapsed().as_secs_f64();
        println!("{layout}: {count} scenes, {rounds} submissions, {seconds:.0} s, {kills} tasks killed");
    }
}
