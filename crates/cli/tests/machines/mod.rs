//! Machines for tests on this machine: each has a host name and process numbers of its own, so a process of
//! one cannot check if a process of another one exists. This needs root on Linux.
#![allow(dead_code, reason = "every test program uses its own part of it")]

use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

/// A machine; its processes end with this value.
pub(crate) struct Fake {
    pub(crate) name: String,
    /// Makes the machine, and ends with it.
    unshare: Child,
    /// The first process of the machine, by its number outside.
    first: u32,
}

/// The fields of `/proc/PID/status` that begin with a name.
fn status(pid: u32, name: &str) -> Vec<u32> {
    let text = std::fs::read_to_string(format!("/proc/{pid}/status")).unwrap_or_default();
    let line = text.lines().find_map(|line| line.strip_prefix(name)?.strip_prefix(':'));
    line.into_iter().flat_map(str::split_whitespace).filter_map(|word| word.parse().ok()).collect()
}

/// The child of a process, once there is one.
fn child_of(parent: u32) -> Option<u32> {
    let numbers = std::fs::read_dir("/proc").ok()?.flatten();
    let mut numbers = numbers.filter_map(|entry| entry.file_name().to_str()?.parse::<u32>().ok());
    numbers.find(|pid| status(*pid, "PPid") == [parent])
}

impl Fake {
    /// Starts a machine; the error is the reason why this is not possible here.
    pub(crate) fn start(name: &str) -> Result<Self, String> {
        let mut unshare = Command::new("unshare");
        unshare.args(["--uts", "--pid", "--fork", "--mount-proc", "--kill-child", "sh", "-c"]);
        // The machine knows its own name.
        let hosts = "hosts=$(mktemp) && echo \"127.0.0.1 localhost $(hostname)\" > $hosts && \
                     mount --bind $hosts /etc/hosts && rm $hosts";
        unshare.arg(format!("hostname {name} && {hosts} && exec sleep 1000000")).stdin(Stdio::null());
        let mut unshare = unshare.stderr(Stdio::null()).spawn().map_err(|e| format!("unshare: {e}"))?;
        let start = Instant::now();
        loop {
            if let Some(first) = child_of(unshare.id())
                && std::fs::read_to_string(format!("/proc/{first}/comm")).is_ok_and(|c| c.trim() == "sleep")
            {
                return Ok(Self { name: name.to_string(), unshare, first });
            }
            let ended = unshare.try_wait().map_err(|e| e.to_string())?.is_some();
            if ended || start.elapsed() > Duration::from_secs(10) {
                let _ = unshare.kill();
                return Err("`unshare --uts --pid` needs root".to_string());
            }
            std::thread::sleep(Duration::from_millis(5));
        }
    }

    /// The same command on this machine.
    pub(crate) fn on(&self, command: &Command) -> Command {
        let mut enter = Command::new("nsenter");
        enter.args(["--target", &self.first.to_string(), "--uts", "--pid", "--mount"]);
        enter.arg(command.get_program()).args(command.get_args());
        for (name, value) in command.get_envs() {
            match value {
                Some(value) => enter.env(name, value),
                None => enter.env_remove(name),
            };
        }
        enter
    }
}

impl Drop for Fake {
    fn drop(&mut self) {
        let _ = self.unshare.kill();
        let _ = self.unshare.wait();
    }
}

/// The process that [`Fake::on`] has started, once it is there: its number outside and inside.
pub(crate) fn inside(enter: &Child) -> Option<(u32, u32)> {
    let outer = child_of(enter.id())?;
    Some((outer, *status(outer, "NSpid").last()?))
}
