//! Provides the build data for `use3d --version`: the commit, the target and the features.

use std::path::{Path, PathBuf};
use std::{env, fs};

/// The folder with git's own files of the work tree at `root`, and the folder that all its work trees share.
fn git_folders(root: &Path) -> Option<(PathBuf, PathBuf)> {
    let entry = root.join(".git");
    if entry.is_dir() {
        return Some((entry.clone(), entry));
    }
    // A second work tree has a file that names its folder, and that folder names the shared one.
    let text = fs::read_to_string(entry).ok()?;
    let own = root.join(text.strip_prefix("gitdir:")?.trim());
    let shared = fs::read_to_string(own.join("commondir")).map(|text| own.join(text.trim()));
    Some((own.clone(), shared.unwrap_or(own)))
}

/// The commit that is checked out at `root`, read from git's files, so that no `git` is needed.
fn commit(root: &Path) -> Option<String> {
    let (own, shared) = git_folders(root)?;
    let watch = |path: &Path| {
        if path.exists() {
            println!("cargo:rerun-if-changed={}", path.display());
        }
    };
    watch(&own.join("HEAD"));
    let head = fs::read_to_string(own.join("HEAD")).ok()?;
    let Some(name) = head.trim().strip_prefix("ref: ") else { return Some(head.trim().to_string()) };
    let (loose, packed) = (shared.join(name), shared.join("packed-refs"));
    watch(&loose);
    watch(&packed);
    if let Ok(commit) = fs::read_to_string(loose) {
        return Some(commit.trim().to_string());
    }
    let packed = fs::read_to_string(packed).ok()?;
    packed.lines().find_map(|line| Some(line.strip_suffix(name)?.trim().to_string()))
}

fn main() {
    println!("cargo:rerun-if-changed=build.rs");
    println!("cargo:rerun-if-env-changed=USE3D_COMMIT");
    let here = env::var("CARGO_MANIFEST_DIR").map(PathBuf::from).unwrap_or_default();
    let root = here.ancestors().nth(2).unwrap_or(&here);
    // The environment may provide the commit for a build from an archive.
    let commit = env::var("USE3D_COMMIT").ok().or_else(|| commit(root));
    let commit = commit.filter(|text| text.len() >= 7 && text.bytes().all(|b| b.is_ascii_hexdigit()));
    let commit = commit.map_or_else(|| "unknown".to_string(), |text| text.chars().take(12).collect());
    println!("cargo:rustc-env=USE3D_COMMIT={commit}");
    println!("cargo:rustc-env=USE3D_TARGET={}", env::var("TARGET").unwrap_or_default());
    let has = |feature: &str| env::var_os(format!("CARGO_FEATURE_{}", feature.to_uppercase())).is_some();
    let features: Vec<&str> = ["gpu", "s3"].into_iter().filter(|feature| has(feature)).collect();
    let features = if features.is_empty() { "none".to_string() } else { features.join(", ") };
    println!("cargo:rustc-env=USE3D_FEATURES={features}");
    let engines = if has("gpu") { "cpu, gpu" } else { "cpu" };
    println!("cargo:rustc-env=USE3D_ENGINES={engines}");
}
