//! Writes the table of code digests (`code.json`) of the workspace that is being built; see the crate `code`.

use std::path::{Path, PathBuf};
use std::{env, fs};

use use3d_code::tree;

fn main() -> Result<(), String> {
    let here = PathBuf::from(env::var("CARGO_MANIFEST_DIR").map_err(|e| e.to_string())?);
    let root =
        here.parent().and_then(Path::parent).ok_or("this crate lives in crates/stages of its workspace")?;
    for folder in tree::crate_folders(root).map_err(|e| e.to_string())? {
        for part in ["src", "templates", "build.rs", "Cargo.toml"] {
            if folder.join(part).exists() {
                println!("cargo:rerun-if-changed={}", folder.join(part).display());
            }
        }
    }
    for file in ["Cargo.toml", "Cargo.lock"] {
        println!("cargo:rerun-if-changed={}", root.join(file).display());
    }
    let table = tree::read(root, "stages").map_err(|e| e.to_string())?;
    let out = PathBuf::from(env::var("OUT_DIR").map_err(|e| e.to_string())?).join("code.json");
    fs::write(&out, table.to_string()).map_err(|e| format!("{}: {e}", out.display()))
}
