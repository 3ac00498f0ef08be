//! Variants compared with one of them: the choice of the reference, and that it is part of the key, while
//! measurements beside an artifact are not.

use std::fs;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::json;
use use3d_workflow::{Batch, BatchScene, Builder, Cache, Registry, Scope, Stage, Variant};

use super::stages::{Fast, code, run};

#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
struct Make {
    /// The text to make.
    text: String,
    /// True if the variant is no reference and is compared with another one.
    copy: bool,
}

#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
struct Judge {}

/// Grows with every run of `judge`: a measurement that differs in every run.
static CLOCK: AtomicU64 = AtomicU64::new(1);

fn registry() -> Registry {
    let make = Stage::new("make", Scope::Scene, |context, p: &Make| {
        Ok(fs::write(context.output().join("made.txt"), &p.text)?)
    });
    let judge = Stage::new("judge", Scope::Scene, |context, _: &Judge| {
        let read = |role: &str| match context.optional_input(role) {
            Some(folder) => fs::read_to_string(folder.join("made.txt")),
            None => Ok("nothing".into()),
        };
        assert!(context.keeps_notes());
        context.note("time", &CLOCK.fetch_add(1, Ordering::Relaxed));
        Ok(fs::write(
            context.output().join("judged.txt"),
            format!("{} by {}", read("scene")?, read("reference")?),
        )?)
    })
    .input("scene", "make")
    .reference_input("reference", "make", |all| {
        all.get("make").is_some_and(|own| own.json()["copy"] == false)
    });
    Registry::new(vec![make, judge], code()).expect("the table is right")
}

fn variant(name: &str, make: serde_json::Value) -> Variant {
    let mut variant = Variant { name: name.into(), ..Variant::default() };
    variant.overrides.insert("make".into(), make);
    variant
}

#[test]
fn all_variants_are_judged_by_the_first_that_is_no_copy_and_rerun_when_it_changes() {
    let dir = tempfile::tempdir().expect("folder");
    let cache =
        |name: &str| Cache::with_files(&dir.path().join(name), false, Arc::new(Fast)).expect("a cache");
    let builder = Builder::new(registry(), cache("cache"));
    let mut batch = Batch { name: "judged".into(), ..Batch::default() };
    batch.scenes.push(BatchScene { name: "reef".into(), ..BatchScene::default() });
    batch.variants = vec![
        variant("copy", json!({"text": "copy", "copy": true})),
        variant("plain", json!({"text": "plain"})),
        variant("other", json!({"text": "other"})),
    ];
    let judged = |builder: &Builder, batch: &Batch| {
        let (summary, started, _) = run(builder, batch);
        assert_eq!(summary.exit_code(), 0);
        let of = |name: &str| {
            let artifact = summary.artifact("reef", name, "judge").expect("judged").clone();
            let text = fs::read_to_string(artifact.path.join("judged.txt")).expect("text");
            (text, artifact.manifest.notes["time"].clone(), artifact.manifest.content)
        };
        (["copy", "plain", "other"].map(of), started.iter().filter(|s| s.ends_with("judge")).count())
    };
    let (first, started) = judged(&builder, &batch);
    assert_eq!(first.clone().map(|f| f.0), ["copy by plain", "plain by plain", "other by plain"]);
    assert_eq!(started, 3);
    // The same stage run a second time: other notes, the same artifact.
    let (again, _) = judged(&Builder::new(registry(), cache("second")), &batch);
    for (a, b) in first.iter().zip(&again) {
        assert_ne!(a.1, b.1);
        assert_eq!(a.2, b.2);
    }
    // The reference is part of every key.
    batch.variants[1] = variant("plain", json!({"text": "changed"}));
    let (changed, started) = judged(&builder, &batch);
    assert_eq!(changed.map(|c| c.0), ["copy by changed", "changed by changed", "other by changed"]);
    assert_eq!(started, 3);
    // Without a reference, each variant is judged alone.
    batch.variants.truncate(1);
    let (summary, _, _) = run(&builder, &batch);
    let artifact = summary.artifact("reef", "copy", "judge").expect("judged");
    assert_eq!(fs::read_to_string(artifact.path.join("judged.txt")).expect("text"), "copy by nothing");
}
