//! The pipeline files that come with the program: a list of them, and the text of one.

use serde::Serialize;
use use3d_config::{schema_text, shipped, shipped_names};
use use3d_pipeline::loaded::stages;
use use3d_workflow::BuildError;

use crate::args::PipelinesArgs;
use crate::error::{Done, WorkError};
use crate::output::json;

/// The name of the JSON schema of all pipeline files, for editors.
const SCHEMA: &str = "schema";

/// An entry of the list.
#[derive(Serialize)]
struct PipelineFile {
    name: &'static str,
    about: String,
}

pub(crate) fn run(args: &PipelinesArgs) -> Done {
    let Some(name) = &args.name else {
        let schema = (SCHEMA, "The JSON schema of pipeline files, for editors.".to_string());
        let files = shipped_names()
            .into_iter()
            .map(|name| (name, first_sentence(&shipped(name).unwrap_or_default())));
        let files = files.chain([schema]);
        let files: Vec<PipelineFile> = files.map(|(name, about)| PipelineFile { name, about }).collect();
        if args.json {
            return json(&files);
        }
        for file in files {
            println!("{:<16} {}", file.name, file.about);
        }
        return Ok(());
    };
    if name == SCHEMA {
        print!("{}", schema_text(&stages()?));
        return Ok(());
    }
    let Some(text) = shipped(name) else {
        let names = shipped_names().into_iter().chain([SCHEMA]);
        return Err(WorkError::input(BuildError::unknown("pipeline", name, names)));
    };
    print!("{text}");
    Ok(())
}

/// The first sentence of the comment at the head of a pipeline file.
fn first_sentence(text: &str) -> String {
    let comment =
        text.lines().filter(|line| !line.starts_with("#:")).map_while(|line| line.strip_prefix("# "));
    let words = comment.collect::<Vec<_>>().join(" ");
    match words.split_once(". ") {
        Some((first, _)) => format!("{first}."),
        None => words,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_file_of_the_folder_is_in_the_program() {
        let folder = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../../pipelines");
        let mut found: Vec<(String, String)> = Vec::new();
        for entry in std::fs::read_dir(folder).expect("the folder") {
            let path = entry.expect("an entry").path();
            if path.extension().is_some_and(|e| e == "toml") {
                let name = path.file_stem().expect("a name").to_string_lossy().into_owned();
                found.push((name, std::fs::read_to_string(&path).expect("a pipeline file")));
            }
        }
        found.sort();
        let of = |name: &str| (name.to_string(), shipped(name).expect("a file"));
        assert_eq!(["demo", "paper", "rivals"].map(of).to_vec(), found);
        for name in shipped_names() {
            let about = first_sentence(&shipped(name).expect("a text"));
            assert!((20..120).contains(&about.len()) && about.ends_with('.'), "{name}: {about}");
        }
    }
}
