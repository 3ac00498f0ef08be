//! Stages on a device: machines without it know its results, and nothing is computed in its place.

use std::fs;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use use3d_workflow::node::Node;
use use3d_workflow::plan::State;
use use3d_workflow::run::NodeResult;
use use3d_workflow::{
    AskedDevice, Batch, Builder, Cache, DeviceClass, Digest, Graph, Registry, Scope, Stage,
};

use super::stages::{Strength, batch, code, in_task, run};

const PROGRAMS: &[u8] = b"programs";

/// A machine with this card, or without one, that shares the cache in `folder`. The counter has the number of
/// times that the card was opened.
fn machine(folder: &Path, card: Option<&'static str>, node: Node) -> (Builder, Arc<AtomicUsize>) {
    let opened = Arc::new(AtomicUsize::new(0));
    let count = opened.clone();
    let train = Stage::new("train", Scope::Scene, |context, _: &Strength| {
        let words = context.input("capture")?.join("images/words.txt");
        Ok(fs::copy(words, context.output().join("score")).map(drop)?)
    })
    .external("capture", "capture")
    .computes_on(
        "device",
        |_: &Strength| {
            Some(AskedDevice { name: "gpu".into(), required: true, programs: Digest::of(PROGRAMS) })
        },
        move |_| {
            count.fetch_add(1, Ordering::Relaxed);
            let card = card.ok_or("no card was found")?;
            let kernels = Digest::of(PROGRAMS);
            Ok(Some(DeviceClass { engine: "wgpu".into(), adapter: card.into(), driver: "1".into(), kernels }))
        },
    );
    let judge = Stage::new("judge", Scope::Scene, |context, _: &Strength| {
        Ok(fs::copy(context.input("train")?.join("score"), context.output().join("verdict")).map(drop)?)
    })
    .input("train", "train");
    let cache = Cache::open(&folder.join("cache"), false).unwrap().as_node(node);
    (Builder::new(Registry::new(vec![train, judge], code()).unwrap(), cache), opened)
}

fn states(builder: &Builder, batch: &Batch) -> Vec<State> {
    let graph = Graph::new(&builder.registry, batch).unwrap();
    builder.plan(&graph, None).nodes.into_iter().map(|node| node.state).collect()
}

#[test]
fn one_that_only_looks_opens_no_device_and_knows_what_it_has_made() {
    let dir = tempfile::tempdir().unwrap();
    let batch = batch(&dir.path().join("data"), &["reef"]);
    let looking = || {
        let (builder, opened) = machine(dir.path(), None, Node::this());
        let states = states(&builder.only_looking(), &batch);
        assert_eq!(opened.load(Ordering::Relaxed), 0);
        states
    };
    let [State::Run(why), State::Waiting(_)] = &looking()[..] else { panic!("{:?}", looking()) };
    assert!(why.contains("`gpu`"), "{why}");
    // A run without the card is refused before anything is computed.
    let (without, _) = machine(dir.path(), None, Node::this());
    let graph = Graph::new(&without.registry, &batch).unwrap();
    let gaps = without.gaps(&graph, None, None).to_string();
    assert!(gaps.contains("no card was found") && gaps.contains("the device `"), "{gaps}");

    let (summary, ..) = run(&machine(dir.path(), Some("a card"), Node::this()).0, &batch);
    assert_eq!(summary.exit_code(), 0, "{summary}");
    assert_eq!(looking(), [State::Cached, State::Cached]);
    // A machine without the card reads its results, and computes nothing in its place.
    assert!(without.gaps(&graph, None, None).is_empty());
    let (summary, started, _) = run(&without, &batch);
    assert_eq!((summary.exit_code(), started.len()), (0, 0), "{summary}");
    let trained = summary.artifact("reef", "", "train").unwrap().path.clone();
    fs::remove_dir_all(trained).unwrap();
    let (summary, started, _) = run(&without, &batch);
    assert_eq!((summary.exit_code() == 0, started.len()), (false, 0), "{summary}");
    assert!(summary.to_string().contains("no card was found"), "{summary}");
}

#[test]
fn the_first_device_of_a_submission_decides_and_others_leave_its_stages_alone() {
    let dir = tempfile::tempdir().unwrap();
    let [both, one] = [&["reef", "wreck"][..], &["reef"]].map(|names| batch(&dir.path().join("data"), names));
    let run_as = |card, id, submission, batch: &Batch| {
        let (summary, started, _) = run(&machine(dir.path(), card, in_task(id, submission)).0, batch);
        (summary, started.len())
    };
    assert_eq!(run_as(Some("a card"), "1", "s", &one).1, 2);
    for (card, words) in [(Some("another"), "a card"), (None, "no card was found")] {
        let (summary, started) = run_as(card, "2", "s", &both);
        assert_eq!((started, summary.exit_code()), (0, 0), "{summary}");
        let left = |result: &NodeResult| matches!(result, NodeResult::Elsewhere(why) if why.contains(words));
        assert_eq!(summary.nodes.iter().filter(|node| left(&node.result)).count(), 2, "{summary}");
    }
    assert_eq!(run_as(Some("a card"), "3", "s", &both).1, 2);
    // In another submission another card may be first. It trains anew, here to the same bytes.
    assert_eq!(run_as(Some("another"), "4", "t", &one).1, 1);
}
