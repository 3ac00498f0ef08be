//! Cleaning up the cache: the artifacts that are cheapest to make again are removed first; those in use
//! never.
//!
//! An artifact is in use if the pipelines to keep would need it now, or if a running process computes it,
//! reads it or plans to use it. The same holds for the checkpoints of trainings that are not finished. The
//! rest is removed until the cache is small enough, in this order: leftovers, checkpoints, artifacts that no
//! last record points to, and finally those that one does. Within each kind the order is by the seconds that
//! it takes to make a byte again. Bytes that several artifacts share are free when the last of them goes.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

use serde::Serialize;

use crate::cache::artifacts::Cache;
use crate::cache::files;
use crate::cache::key::Key;
use crate::cache::machine;
use crate::cache::manifest::{MANIFEST, Manifest};
use crate::plan::planning::Plan;
use crate::share::lease;

/// Options of a cleaning.
#[derive(Clone, Debug, Default)]
pub struct CleanOptions {
    /// Remove until the cache is at most this large.
    pub max_bytes: Option<u64>,
    /// Remove items that were not used for this long.
    pub older_than: Option<Duration>,
    /// Artifacts and checkpoints to keep, see [`Plan::keys`].
    pub keep: BTreeSet<Key>,
    /// Report what would be removed, and remove nothing.
    pub dry_run: bool,
}

/// A removed item.
#[derive(Clone, Debug, Serialize)]
pub struct Removed {
    /// Its kind: artifact, checkpoints, damaged, leftover.
    pub kind: &'static str,
    /// The stage, and the scene it was made for.
    pub name: String,
    /// Its size.
    pub bytes: u64,
    /// The reason for removing it.
    pub reason: String,
    /// Its path.
    pub path: PathBuf,
}

/// Report of a cleaning, or of a dry run.
#[derive(Clone, Debug, Serialize)]
pub struct Cleaning {
    /// The removed items.
    pub removed: Vec<Removed>,
    /// The items that could not be removed, each with the error.
    pub failed: Vec<(String, String)>,
    /// Bytes left in the cache.
    pub left: u64,
    /// True for a dry run, which removes nothing.
    pub dry_run: bool,
}

impl Plan {
    /// The keys that a cleaning must keep for this pipeline: those of all artifacts that the plan finds in
    /// the cache, and of the checkpoints from which unfinished stages would resume.
    pub fn keys(&self) -> impl Iterator<Item = Key> + '_ {
        self.nodes.iter().filter_map(|n| if n.artifact.is_some() { n.key } else { n.checkpoints })
    }
}

struct Item {
    kind: &'static str,
    rank: u8,
    name: String,
    bytes: u64,
    /// The seconds that it takes to make it again.
    seconds: f64,
    /// The size of the files that other items link to as well, by file.
    linked: BTreeMap<(u64, u64), u64>,
    cost: f64,
    used: SystemTime,
    path: PathBuf,
    /// The key of the artifact or of the checkpoints, by which the item can be kept.
    key: Option<Key>,
}

impl Item {
    /// An item with the bytes below its folder and the time of its last use. `made` has its key, and the
    /// seconds that it takes to make it again.
    fn measure(kind: &'static str, rank: u8, name: String, path: PathBuf, made: (Option<Key>, f64)) -> Self {
        let ((key, seconds), mut all) = (made, 0);
        let mut item = Self {
            kind,
            rank,
            name,
            bytes: 0,
            seconds,
            linked: BTreeMap::new(),
            cost: 0.0,
            used: SystemTime::UNIX_EPOCH,
            path,
            key,
        };
        for entry in walkdir::WalkDir::new(&item.path).into_iter().filter_map(Result::ok) {
            let Ok(metadata) = entry.metadata() else { continue };
            item.used = item.used.max(metadata.modified().unwrap_or(SystemTime::UNIX_EPOCH));
            if metadata.is_file() {
                all += metadata.len();
                match files::linked(&metadata) {
                    Some(file) => drop(item.linked.insert(file, metadata.len())),
                    None => item.bytes += metadata.len(),
                }
            }
        }
        item.cost = item.seconds / all.max(1) as f64;
        item
    }
}

impl Cache {
    /// Cleans up.
    pub fn clean(&self, options: &CleanOptions) -> Cleaning {
        let mut items = self.items();
        let kept = |item: &Item, busy: &BTreeSet<Key>| {
            item.key.is_some_and(|k| options.keep.contains(&k) || busy.contains(&k))
        };
        let busy = lease::in_use(self);
        let mut links: BTreeMap<(u64, u64), (u64, usize)> = BTreeMap::new();
        for (file, size) in items.iter().flat_map(|item| &item.linked) {
            links.entry(*file).or_insert((*size, 0)).1 += 1;
        }
        let mut total: u64 =
            items.iter().map(|i| i.bytes).sum::<u64>() + links.values().map(|l| l.0).sum::<u64>();
        let now = SystemTime::now();
        items.sort_by(|a, b| a.rank.cmp(&b.rank).then(a.cost.total_cmp(&b.cost)).then(a.used.cmp(&b.used)));
        let mut cleaning =
            Cleaning { removed: Vec::new(), failed: Vec::new(), left: 0, dry_run: options.dry_run };
        for item in items.into_iter().filter(|i| !kept(i, &busy)) {
            let age = now.duration_since(item.used).unwrap_or_default();
            let reason = if item.rank == 0 {
                "left over".to_string()
            } else if options.older_than.is_some_and(|limit| age > limit) {
                format!("not used for {}", machine::seconds(age.as_secs_f64()))
            } else if options.max_bytes.is_some_and(|limit| total > limit) {
                let seconds = machine::seconds(item.seconds);
                match item.kind {
                    "artifact" => format!("takes {seconds} to compute again"),
                    _ => "only saves time".to_string(),
                }
            } else {
                continue;
            };
            if !options.dry_run {
                // Removing takes time; meanwhile another run may have started to need the item.
                if kept(&item, &lease::in_use(self)) {
                    continue;
                }
                if let Err(error) = self.discard(&item.path) {
                    cleaning.failed.push((item.name, error.source.to_string()));
                    continue;
                }
                if let (Some(key), "artifact") = (&item.key, item.kind) {
                    self.forget_fetched(key);
                }
            }
            let Item { kind, name, mut bytes, path, linked, .. } = item;
            for link in linked.keys() {
                if let Some((size, items)) = links.get_mut(link) {
                    *items -= 1;
                    bytes += if *items == 0 { *size } else { 0 };
                }
            }
            total -= bytes;
            cleaning.removed.push(Removed { kind, name, bytes, reason, path });
        }
        if !options.dry_run {
            self.sweep();
            self.contents.forget_missing();
            if let Err(error) = self.contents.save() {
                cleaning.failed.push(("stat table".to_string(), error.to_string()));
            }
        }
        cleaning.left = total;
        cleaning
    }

    /// Lists all items in the cache that take space.
    fn items(&self) -> Vec<Item> {
        let records = self.all_records();
        let current: BTreeSet<Key> = records.iter().filter_map(|r| r.last.as_ref().map(|m| m.key)).collect();
        let mut items = Vec::new();
        for (stage, key, path) in self.artifacts() {
            let manifest =
                std::fs::read(path.join(MANIFEST)).ok().and_then(|b| Manifest::parse(&b, key).ok());
            let rank = if current.contains(&key) { 3 } else { 2 };
            let (rank, seconds, name) = match &manifest {
                Some(m) => (rank, m.full_seconds(), format!("{stage} of {}", m.made_for)),
                None => (0, 0.0, format!("{stage} {} (no whole manifest)", key.short())),
            };
            items.push(Item::measure("artifact", rank, name, path, (Some(key), seconds)));
        }
        let mut add = |kind: &'static str, rank: u8, path: PathBuf, name: String, key: Option<Key>| {
            items.push(Item::measure(kind, rank, name, path, (key, 0.0)));
        };
        for stage in below(&self.root().join("checkpoints")) {
            for path in below(&stage) {
                let folder = last(&path);
                let name = format!("{} {}", last(&stage), folder.get(..12).unwrap_or(&folder));
                add("checkpoints", 1, path, name, folder.parse().ok());
            }
        }
        for path in below(&self.root().join("killed")) {
            let (name, key) = (last(&path), path.file_stem().and_then(|stem| stem.to_str()?.parse().ok()));
            add("note of a killed process", 1, path, name, key);
        }
        for (folder, kind, rank) in
            [("delivered", "notes of delivered results", 1), ("damaged", "damaged", 0)]
        {
            for path in below(&self.root().join(folder)) {
                let name = last(&path);
                add(kind, rank, path, name, None);
            }
        }
        items
    }
}

fn below(folder: &Path) -> Vec<PathBuf> {
    let mut paths: Vec<PathBuf> = files::entries(folder).map(|entry| entry.path()).collect();
    paths.sort();
    paths
}

fn last(path: &Path) -> String {
    path.file_name().unwrap_or_default().to_string_lossy().into_owned()
}

/// A text that is no size and no age.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum AmountError {
    /// The text is not a size.
    #[error("`{0}` is not a size: a number and B, kB, MB, GB, TB, KiB, MiB, GiB or TiB, e.g. 50GB")]
    Size(String),
    /// The text is a number without a unit.
    #[error("{0} has no unit: write {0}GB, {0}MB, or {0}B for bytes")]
    NoUnit(String),
    /// The text is not an age.
    #[error("`{0}` is not an age: a number and s, min, h, d or w, e.g. 30d")]
    Age(String),
}

/// Parses a size such as `50GB`, `1.5 TB`, `800MiB` or `0`. Other numbers need a unit: somebody who writes 5
/// means gigabytes, and 5 bytes would remove everything.
pub fn parse_bytes(text: &str) -> Result<u64, AmountError> {
    let wrong = || AmountError::Size(text.to_string());
    let (number, unit) = split_unit(text).ok_or_else(wrong)?;
    let factor = match unit.to_lowercase().as_str() {
        "" if number > 0.0 => return Err(AmountError::NoUnit(text.to_string())),
        "" | "b" => 1.0,
        "k" | "kb" => 1e3,
        "m" | "mb" => 1e6,
        "g" | "gb" => 1e9,
        "t" | "tb" => 1e12,
        "kib" => 1024.0,
        "mib" => 1_048_576.0,
        "gib" => 1_073_741_824.0,
        "tib" => 1_099_511_627_776.0,
        _ => return Err(wrong()),
    };
    Ok((number * factor) as u64)
}

/// Parses an age such as `30d`, `12h` or `2w`.
pub fn parse_age(text: &str) -> Result<Duration, AmountError> {
    let wrong = || AmountError::Age(text.to_string());
    let (number, unit) = split_unit(text).ok_or_else(wrong)?;
    let factor = match unit {
        "s" => 1.0,
        "min" => 60.0,
        "h" => 3600.0,
        "d" => 86_400.0,
        "w" => 604_800.0,
        _ => return Err(wrong()),
    };
    Ok(Duration::from_secs_f64((number * factor).min(1e12)))
}

fn split_unit(text: &str) -> Option<(f64, &str)> {
    let text = text.trim();
    let end = text.find(|c: char| !c.is_ascii_digit() && c != '.').unwrap_or(text.len());
    let number: f64 = text[..end].parse().ok()?;
    Some((number, text[end..].trim()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_and_ages() {
        assert_eq!(parse_bytes("50GB"), Ok(50_000_000_000));
        assert_eq!(parse_bytes("1.5 MiB"), Ok(1_572_864));
        assert_eq!((parse_bytes("1000B"), parse_bytes("0")), (Ok(1000), Ok(0)));
        assert!(parse_bytes("5").unwrap_err().to_string().contains("5GB"));
        assert_eq!(parse_age("30d"), Ok(Duration::from_secs(30 * 86_400)));
        assert_eq!(parse_age("1.5h"), Ok(Duration::from_secs(5400)));
        for wrong in ["", "GB", "5 parrots", "-3GB", "1..2"] {
            assert!(parse_bytes(wrong).is_err(), "{wrong}");
            assert!(parse_age(wrong).is_err(), "{wrong}");
        }
    }
}
