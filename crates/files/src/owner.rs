//! Identifies the process that owns a file, among all processes of all machines that share a folder.

use std::hash::{BuildHasher, Hasher, RandomState};
use std::path::Path;
use std::sync::OnceLock;

use serde::{Deserialize, Serialize};

/// Identifies a running process: host and boot, id, start time.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ProcessId {
    /// The machine since its last boot, and the namespace of its process ids.
    pub place: String,
    /// The process id.
    pub pid: u32,
    /// Its start time in the system's own units, which distinguishes a reused id.
    pub started: u64,
}

impl ProcessId {
    /// This process.
    pub fn this() -> Self {
        let pid = std::process::id();
        Self { place: place(), pid, started: start_time(pid).unwrap_or(0) }
    }

    /// Returns a short name that marks the files and folders of this process. Processes of two containers may
    /// have the same name.
    pub fn name(&self) -> String {
        format!("{}-{}-{}", short(&self.place), self.pid, self.started)
    }

    /// Returns true if the process is running whose name a file has (a further `-` and any text may follow);
    /// `None` if it belongs to another machine.
    pub fn owner_is_alive(name: &str) -> Option<bool> {
        let mut parts = name.split('-');
        let here = place();
        if parts.next()? != short(&here) {
            return None;
        }
        let (pid, started) = (parts.next()?.parse().ok()?, parts.next()?.parse().ok()?);
        Self { place: here, pid, started }.is_alive()
    }

    /// Returns true if the process runs, false if it has ended, and `None` if it belongs to another machine.
    pub fn is_alive(&self) -> Option<bool> {
        if self.place != place() {
            return None;
        }
        if !Path::new("/proc/self/stat").exists() {
            return if self.pid == std::process::id() { Some(true) } else { None };
        }
        Some(start_time(self.pid).is_some_and(|s| s == self.started))
    }
}

/// The first twelve digits of a text's digest.
fn short(text: &str) -> String {
    blake3::hash(text.as_bytes()).to_hex()[..12].to_string()
}

/// Returns the name of this machine.
pub fn host() -> String {
    let host = std::fs::read_to_string("/proc/sys/kernel/hostname")
        .ok()
        .or_else(|| std::env::var("HOSTNAME").ok())
        .or_else(|| std::env::var("COMPUTERNAME").ok());
    host.map_or_else(|| "unknown".to_string(), |h| h.trim().to_string())
}

fn place() -> String {
    static PLACE: OnceLock<String> = OnceLock::new();
    let find = || {
        let boot = std::fs::read_to_string("/proc/sys/kernel/random/boot_id").unwrap_or_default();
        let space = std::fs::read_link("/proc/self/ns/pid").map(|p| p.display().to_string());
        place_of(&host(), boot.trim(), &space.unwrap_or_default())
    };
    PLACE.get_or_init(find).clone()
}

/// A host's name alone does not identify a machine, because two machines may have the same name. If the
/// system does not report the machine and the namespace of process ids, the process gets a place of its own.
fn place_of(host: &str, boot: &str, space: &str) -> String {
    if boot.is_empty() || space.is_empty() {
        return format!("{host} {:016x}", random());
    }
    format!("{host} {boot} {space}")
}

/// Returns a number that no other call in any process gets, from the system's source of randomness. It is
/// never used for results.
pub fn random() -> u64 {
    RandomState::new().build_hasher().finish()
}

/// Field 22 of `/proc/<pid>/stat`; a zombie has ended.
fn start_time(pid: u32) -> Option<u64> {
    let stat = std::fs::read_to_string(format!("/proc/{pid}/stat")).ok()?;
    let mut fields = stat[stat.rfind(')')? + 1..].split_whitespace();
    if fields.next()? == "Z" {
        return None;
    }
    fields.nth(18)?.parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn machines_of_one_name_are_not_one_place() {
        assert_eq!(place_of("a", "boot", "space"), place_of("a", "boot", "space"));
        for (boot, space) in [("", ""), ("boot", ""), ("", "space")] {
            assert_ne!(place_of("a", boot, space), place_of("a", boot, space), "{boot} {space}");
        }
    }

    #[test]
    fn this_process_is_alive_and_another_start_is_not() {
        let this = ProcessId::this();
        assert_eq!(this.is_alive(), Some(true));
        assert_eq!(ProcessId::owner_is_alive(&format!("{}-1", this.name())), Some(true));
        assert_eq!(ProcessId::owner_is_alive("elsewhere-1-2-3"), None);
        if this.started != 0 {
            assert_eq!(ProcessId { started: this.started + 1, ..this.clone() }.is_alive(), Some(false));
        }
        assert_eq!(ProcessId { place: "elsewhere".to_string(), ..this }.is_alive(), None);
    }
}
