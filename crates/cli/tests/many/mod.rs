//! A pipeline of several tiny captures, and the files that its runs make.
#![allow(dead_code, reason = "every test program uses its own part of it")]

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::Command;

use crate::tiny::{NO_WATER, TINY, command, files, synthesise};

pub(crate) struct Many {
    pub(crate) dir: tempfile::TempDir,
    /// Number of captures.
    pub(crate) count: usize,
}

/// Settings with which a run of them takes seconds, as arguments of `use3d run` and `use3d submit`.
pub(crate) fn settings() -> Vec<String> {
    let quick =
        ["reconstruct.iterations=12", "enhance.iterations=6", "reconstruct.checkpoint_steps=2", NO_WATER];
    TINY.iter().chain(&quick).flat_map(|set| ["--set".to_string(), (*set).to_string()]).collect()
}

impl Many {
    pub(crate) fn new(names: &[String]) -> Self {
        let many = Self { dir: tempfile::tempdir().expect("a folder"), count: names.len() };
        let mut text = "name = \"many\"\nseed = 42\n".to_string();
        for (seed, name) in names.iter().enumerate() {
            many.synth("capture", name, 9, "64x48", seed + 1);
            text += &format!("[[scene]]\nname = \"{name}\"\ncapture = \"{name}\"\ngroup = \"Tiny\"\n");
        }
        std::fs::write(many.at("many.toml"), text).expect("written");
        many
    }

    /// As many scenes as in `USE3D_SCENES`, or `usual`; with `use26`, the scenes of that pipeline file.
    pub(crate) fn asked(usual: usize) -> Self {
        let asked = std::env::var("USE3D_SCENES").unwrap_or_else(|_| usual.to_string());
        if asked == "use26" {
            return Self::use26();
        }
        let count = asked.parse().expect("a number of scenes, or use26");
        Self::new(&(1..=count).map(|n: usize| format!("s{n:02}")).collect::<Vec<_>>())
    }

    /// `pipelines/use26.toml` with smaller sizes, and with synthetic captures and pairs of the same names and
    /// shapes instead of its data.
    fn use26() -> Self {
        let mut text = use3d_config::shipped("use26").expect("a shipped pipeline");
        for (large, small) in [("1400x933", "72x48"), ("1920x1080", "80x45")] {
            text = text.replace(large, small);
        }
        // Folders beside the file replace the variables that users set.
        text = text.replace("${UIEB}", "UIEB");
        let mut name = String::new();
        let named = text.lines().map(|line| {
            if line.starts_with("name =") {
                name = line.split('"').nth(1).unwrap_or_default().to_string();
            }
            if line.starts_with("download =") {
                format!("capture = \"scenes/{name}\"\n")
            } else {
                format!("{line}\n")
            }
        });
        let text: String = named.collect();
        let mut many = Self { dir: tempfile::tempdir().expect("a folder"), count: 0 };
        let value = |line: &str| line.split('"').nth(1).map(String::from).expect("a value in quotes");
        let of = |key: &str| text.lines().filter(|l| l.starts_with(key)).map(value).collect::<Vec<_>>();
        for (capture, size) in of("capture =").iter().zip(of("size =")) {
            many.count += 1;
            many.synth("capture", capture, 9, &size, many.count);
        }
        many.synth("pairs", "UIEB", 8, "64x48", 1);
        for (made, named) in [("input", "raw-890"), ("reference", "reference-890")] {
            std::fs::rename(many.at("UIEB").join(made), many.at("UIEB").join(named)).expect("renamed");
        }
        std::fs::write(many.at("many.toml"), text).expect("written");
        many
    }

    fn synth(&self, what: &str, name: &str, views: usize, size: &str, seed: usize) {
        let (views, seed) = (views.to_string(), seed.to_string());
        synthesise(&self.at(name), &[what, "--views", &views, "--size", size, "--seed", &seed]);
    }

    pub(crate) fn at(&self, name: &str) -> PathBuf {
        self.dir.path().join(name)
    }

    /// `use3d VERBS many.toml` with the cache of that name and quick settings.
    pub(crate) fn command(&self, verbs: &[&str], cache: &str) -> Command {
        let mut command = command();
        command.args(verbs).arg(self.at("many.toml")).arg("--cache").arg(self.at(cache));
        command.args(settings()).current_dir(self.dir.path());
        command
    }

    /// Every byte of the artifacts in a cache except their manifests, which contain times and hosts.
    pub(crate) fn artifacts(&self, cache: &str) -> BTreeMap<PathBuf, Vec<u8>> {
        let mut all = files(&self.at(cache).join("v1/artifacts"));
        all.retain(|path, _| !path.ends_with("manifest.json"));
        all
    }

    /// The files of the reference that a cache lacks or has with other bytes, and files that the reference
    /// lacks. A submission that was disturbed also leaves a report of the scenes that it had; such reports do
    /// not count.
    pub(crate) fn apart(
        cache: &BTreeMap<PathBuf, Vec<u8>>,
        whole: &BTreeMap<PathBuf, Vec<u8>>,
    ) -> Vec<PathBuf> {
        let wrong =
            whole.iter().filter(|(name, bytes)| cache.get(*name) != Some(*bytes)).map(|(name, _)| name);
        let more = cache.keys().filter(|name| !whole.contains_key(*name) && !name.starts_with("report"));
        wrong.chain(more).cloned().collect()
    }

    /// A run of one process from an empty cache, the reference for all others.
    pub(crate) fn alone(&self) -> BTreeMap<PathBuf, Vec<u8>> {
        let mut command = self.command(&["-q", "run"], "alone");
        let output = command.arg("--out").arg(self.at("out-alone")).output().expect("the command starts");
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        self.artifacts("alone")
    }

    /// The delivered scores of every scene.
    pub(crate) fn scores(&self, out: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
        let mut all = files(&self.at("").join(out));
        all.retain(|path, _| path.ends_with("scores/scores.json"));
        all
    }
}

/// The processes of this cache's runs.
pub(crate) fn workers(cache: &str) -> Vec<u32> {
    let mut found = Vec::new();
    for entry in std::fs::read_dir("/proc").expect("processes").flatten() {
        let Ok(pid) = entry.file_name().to_string_lossy().parse() else { continue };
        let line = std::fs::read(entry.path().join("cmdline")).unwrap_or_default();
        let line = String::from_utf8_lossy(&line).replace('\0', " ");
        if line.starts_with(env!("CARGO_BIN_EXE_use3d")) && line.contains(cache) {
            found.push(pid);
        }
    }
    found
}
