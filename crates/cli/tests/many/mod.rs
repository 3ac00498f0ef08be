//! A pipeline of several tiny captures, and what runs of it leave.
#![allow(dead_code, reason = "every test program uses its own part of it")]

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::Command;

use crate::tiny::{TINY, command, files};

pub(crate) struct Many {
    pub(crate) dir: tempfile::TempDir,
}

/// What makes a run of them take seconds, as words of `use3d run` and `use3d submit`.
pub(crate) fn settings() -> Vec<String> {
    let quick = ["reconstruct.iterations=12", "enhance.iterations=6", "reconstruct.checkpoint_steps=2"];
    TINY.iter().chain(&quick).flat_map(|set| ["--set".to_string(), (*set).to_string()]).collect()
}

impl Many {
    pub(crate) fn new(names: &[String]) -> Self {
        let many = Self { dir: tempfile::tempdir().expect("a folder") };
        let mut text = "name = \"many\"\nseed = 42\n".to_string();
        for (seed, name) in names.iter().enumerate() {
            let mut synth = command();
            synth.args(["-q", "synth", "capture", "--out"]).arg(many.at(name));
            synth.args(["--views", "9", "--size", "64x48", "--seed", &(seed + 1).to_string()]);
            let output = synth.output().expect("the command starts");
            assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
            text += &format!("[[scene]]\nname = \"{name}\"\ncapture = \"{name}\"\ngroup = \"Tiny\"\n");
        }
        std::fs::write(many.at("many.toml"), text).expect("written");
        many
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

    /// Every byte of the artifacts in a cache but their manifests, which tell times and hosts.
    pub(crate) fn artifacts(&self, cache: &str) -> BTreeMap<PathBuf, Vec<u8>> {
        let mut all = files(&self.at(cache).join("v1/artifacts"));
        all.retain(|path, _| !path.ends_with("manifest.json"));
        all
    }

    /// A run of one process, from nothing: what all others are compared with.
    pub(crate) fn alone(&self) -> BTreeMap<PathBuf, Vec<u8>> {
        let mut command = self.command(&["-q", "run"], "alone");
        let output = command.arg("--out").arg(self.at("out-alone")).output().expect("the command starts");
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        self.artifacts("alone")
    }

    /// The scores that were delivered of every scene.
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
