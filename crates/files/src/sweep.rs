//! Removes the temporary files and folders of killed processes.

use std::path::Path;

use crate::owner::ProcessId;

/// Removes files and folders in `folder` whose names are `prefix` and a [unique](crate::unique) name of a
/// process that has ended, if `may_go` returns true. An item that cannot be removed stays, which is harmless.
pub fn sweep(folder: &Path, prefix: &str, may_go: impl Fn(&Path) -> bool) {
    for entry in std::fs::read_dir(folder).into_iter().flatten().filter_map(Result::ok) {
        let name = entry.file_name();
        let owner = name.to_str().and_then(|name| name.strip_prefix(prefix));
        if owner.and_then(ProcessId::owner_is_alive) != Some(false) || !may_go(&entry.path()) {
            continue;
        }
        if entry.file_type().is_ok_and(|kind| kind.is_dir()) {
            let _ = std::fs::remove_dir_all(entry.path());
        } else {
            let _ = std::fs::remove_file(entry.path());
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::unique;

    #[test]
    fn only_what_the_gone_left_is_removed() {
        let this = ProcessId::this();
        let other = ProcessId { started: this.started + 1, ..this };
        if other.is_alive() != Some(false) {
            return; // a system that does not report it
        }
        let gone = other.name();
        let dir = tempfile::tempdir().unwrap();
        let mut kept = vec![
            format!(".tmp-{}", unique()),
            ".tmp-elsewhere-1-2-3".to_string(),
            ".tmp-mine".to_string(),
            format!("other-{gone}-0"),
            format!(".tmp-{gone}-kept"),
        ];
        let left = [format!(".tmp-{gone}-0"), format!(".tmp-{gone}")];
        for name in kept.iter().chain(&left) {
            std::fs::create_dir_all(dir.path().join(name).join("deep")).unwrap();
        }
        std::fs::write(dir.path().join(format!(".tmp-{gone}-file")), "half").unwrap();
        sweep(dir.path(), ".tmp-", |path| !path.ends_with(&kept[4]));
        let list = std::fs::read_dir(dir.path()).unwrap();
        let mut names: Vec<String> = list.map(|e| e.unwrap().file_name().into_string().unwrap()).collect();
        names.sort();
        kept.sort();
        assert_eq!(names, kept);
    }
}
