//! The memory that this process may still take: for planning, for notices and for refusing work that does not
//! fit.
//!
//! It never affects the result of a stage, because an artifact does not depend on the machine that made it.
//! The value is the least of three: the memory that the system can give without swapping, the rest that the
//! process's control groups (a container's limit, version 1 or 2) leave, and the rest that its address-space
//! limit (`ulimit -v`) leaves.

use std::path::Path;

use crate::cache::machine::bytes;
use crate::error::StageError;

/// Available bytes, from the files below `root` (`/`); `None` where the system reports nothing.
pub(crate) fn available(root: &Path) -> Option<u64> {
    let system = kibibytes(&root.join("proc/meminfo"), "MemAvailable:");
    [system, control_groups(root), address_space(root)].into_iter().flatten().min()
}

/// Memory this process holds, bytes.
pub(crate) fn resident() -> Option<u64> {
    kibibytes(Path::new("/proc/self/status"), "VmRSS:")
}

/// Checks work that takes `start` bytes at the start and `most` at the most, where `free` bytes are
/// available. Returns an error if it cannot start, and a notice if it may run out of memory. `lower` is the
/// text that says how to need less.
pub(crate) fn judge(free: u64, start: u64, most: u64, lower: &str) -> Result<Option<String>, StageError> {
    let [free_text, start_text, most_text] = [free, start, most].map(bytes);
    if start > free {
        return Err(StageError::message(format!(
            "needs about {start_text} of memory to begin, and {free_text} are available (the limits of a \
             container count); {lower}, or use a machine with more memory"
        )));
    }
    Ok((most > free).then(|| {
        format!(
            "may need up to {most_text} of memory, and {free_text} are available; if it runs out, {lower}"
        )
    }))
}

/// The bytes of a line `NAME  123 kB`.
fn kibibytes(file: &Path, name: &str) -> Option<u64> {
    let text = std::fs::read_to_string(file).ok()?;
    let line = text.lines().find(|l| l.starts_with(name))?;
    line.split_whitespace().nth(1)?.parse::<u64>().ok()?.checked_mul(1024)
}

/// The files in which one version of control groups reports its numbers.
struct Version {
    mount: &'static str,
    limit: &'static str,
    used: &'static str,
    reclaimable: &'static str,
}

const VERSION_1: Version = Version {
    mount: "sys/fs/cgroup/memory",
    limit: "memory.limit_in_bytes",
    used: "memory.usage_in_bytes",
    reclaimable: "total_inactive_file",
};
const VERSION_2: Version = Version {
    mount: "sys/fs/cgroup",
    limit: "memory.max",
    used: "memory.current",
    reclaimable: "inactive_file",
};

/// Memory left by the strictest of the process's control groups.
fn control_groups(root: &Path) -> Option<u64> {
    let text = std::fs::read_to_string(root.join("proc/self/cgroup")).ok()?;
    let groups = text.lines().filter_map(|line| {
        // `4:memory:/path` in version 1, `0::/path` in version 2.
        let mut parts = line.splitn(3, ':');
        let (_, controllers, path) = (parts.next()?, parts.next()?, parts.next()?);
        let version = match controllers {
            "" => VERSION_2,
            list if list.split(',').any(|c| c == "memory") => VERSION_1,
            _ => return None,
        };
        version.left(root, path)
    });
    groups.min()
}

impl Version {
    /// Memory left by the limits of a group and its parents, because a limit holds for everything below it.
    /// In a container the path may be the host's; then only the mount folder itself exists.
    fn left(&self, root: &Path, path: &str) -> Option<u64> {
        let mount = root.join(self.mount);
        let folder = mount.join(path.trim_start_matches('/'));
        let groups = folder.ancestors().take_while(|group| group.starts_with(&mount));
        groups.filter_map(|group| self.left_in(group)).min()
    }

    /// Limit − used + the part of the page cache that is reclaimed first. No limit is written as `max` or as
    /// a number larger than any machine.
    fn left_in(&self, folder: &Path) -> Option<u64> {
        let number = |file: &str| std::fs::read_to_string(folder.join(file)).ok()?.trim().parse::<u64>().ok();
        let limit = number(self.limit).filter(|l| *l < 1 << 60)?;
        let statistics = std::fs::read_to_string(folder.join("memory.stat")).unwrap_or_default();
        let reclaimable = statistics.lines().find_map(|line| {
            line.strip_prefix(self.reclaimable)?.strip_prefix(' ')?.trim().parse::<u64>().ok()
        });
        let used = number(self.used).unwrap_or(0).saturating_sub(reclaimable.unwrap_or(0));
        Some(limit.saturating_sub(used))
    }
}

/// Address space left by `ulimit -v`.
fn address_space(root: &Path) -> Option<u64> {
    let text = std::fs::read_to_string(root.join("proc/self/limits")).ok()?;
    let line = text.lines().find_map(|l| l.strip_prefix("Max address space"))?;
    let limit: u64 = line.split_whitespace().next()?.parse().ok()?;
    Some(limit.saturating_sub(kibibytes(&root.join("proc/self/status"), "VmSize:").unwrap_or(0)))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn machine(files: &[(&str, &str)]) -> tempfile::TempDir {
        let root = tempfile::tempdir().expect("folder");
        for (path, text) in files {
            let path = root.path().join(path);
            std::fs::create_dir_all(path.parent().expect("a folder")).expect("folder");
            std::fs::write(path, text).expect("file");
        }
        root
    }

    #[test]
    fn what_cannot_begin_is_refused_and_what_may_not_end_is_said() {
        let judged = |free| judge(free, 2_000_000, 9_000_000, "lower `max_gaussians`");
        assert_eq!(judged(9_000_000).expect("it can begin"), None);
        let notice = judged(8_000_000).expect("it can begin").expect("a notice");
        assert!(notice.contains("9.0 MB") && notice.contains("max_gaussians"), "{notice}");
        let refusal = judged(1_999_999).expect_err("too little").to_string();
        assert!(refusal.contains("2.0 MB of memory to begin"), "{refusal}");
    }

    #[test]
    fn the_strictest_of_all_limits_counts() {
        const MEMINFO: (&str, &str) =
            ("proc/meminfo", "MemTotal:       9000 kB\nMemAvailable:       8000 kB\n");
        let of = |files: &[(&str, &str)]| {
            let mut all = vec![MEMINFO];
            all.extend(files);
            available(machine(&all).path())
        };
        assert_eq!(available(machine(&[]).path()), None);
        assert_eq!(of(&[]), Some(8000 * 1024));
        // Version 2: a limit of a parent holds too, reclaimable pages do not count, `max` is none.
        let group = ("proc/self/cgroup", "0::/a/b\n");
        let inner = ("sys/fs/cgroup/a/b/memory.max", "max\n");
        let outer = [
            ("sys/fs/cgroup/a/memory.max", "5000000\n"),
            ("sys/fs/cgroup/a/memory.current", "1500000\n"),
            ("sys/fs/cgroup/a/memory.stat", "anon 9\ninactive_file 500000\n"),
        ];
        assert_eq!(of(&[group, inner]), Some(8000 * 1024));
        assert_eq!(of(&[group, inner, outer[0], outer[1], outer[2]]), Some(4_000_000));
        // Version 1, inside a container that sees only its own folder.
        assert_eq!(
            of(&[
                ("proc/self/cgroup", "5:cpu:/x\n4:memory:/docker/1\n"),
                ("sys/fs/cgroup/memory/memory.limit_in_bytes", "3000000\n"),
                ("sys/fs/cgroup/memory/memory.usage_in_bytes", "1000000\n"),
            ]),
            Some(2_000_000)
        );
        assert_eq!(
            of(&[
                ("proc/self/cgroup", "4:memory:/\n"),
                ("sys/fs/cgroup/memory/memory.limit_in_bytes", "9223372036854771712\n"),
            ]),
            Some(8000 * 1024)
        );
        let limits = "Max address space         4000000              unlimited            bytes\n";
        assert_eq!(
            of(&[("proc/self/limits", limits), ("proc/self/status", "VmSize:\t 1000 kB\n")]),
            Some(4_000_000 - 1_024_000)
        );
        let unlimited = "Max address space         unlimited            unlimited            bytes\n";
        assert_eq!(of(&[("proc/self/limits", unlimited)]), Some(8000 * 1024));
    }
}
