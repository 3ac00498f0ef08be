//! A store far away answers late: many requests are made at the same time, and nothing to do is found soon.

use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use use3d_workflow::{Event, Graph, Listener};

use super::faulty_store::Faulty;
use super::remote::{World, shared};
use super::stages::payload;

/// Keeps the texts of the notes.
#[derive(Default)]
struct Notes(Mutex<Vec<String>>);

impl Listener for Notes {
    fn event(&self, event: &Event<'_>) {
        if let Event::Note { text, .. } = event {
            self.0.lock().expect("notes").push((*text).to_string());
        }
    }
}

#[test]
fn many_requests_are_made_at_once_and_no_more_than_thirty_two() {
    let scenes: Vec<String> = (0..20).map(|n| format!("s{n}")).collect();
    let world = World::of(&scenes.iter().map(String::as_str).collect::<Vec<_>>());
    let (now, most) = (AtomicUsize::new(0), Arc::new(AtomicUsize::new(0)));
    let peak = most.clone();
    let remote = Arc::new(Faulty::new(move |_, _| {
        peak.fetch_max(now.fetch_add(1, Ordering::SeqCst) + 1, Ordering::SeqCst);
        std::thread::sleep(Duration::from_millis(20));
        now.fetch_sub(1, Ordering::SeqCst);
        None
    }));
    let (store, alone, notes) = (shared(&remote), world.builder("alone"), Arc::new(Notes::default()));
    let graph = Graph::new(&alone.registry, &world.batch).expect("graph");
    let listener: Arc<dyn Listener> = notes.clone();
    let stop = AtomicBool::new(false);
    let sent = alone.push(&graph, &store, false, &stop, &listener).expect("pushed");
    let sending = most.swap(0, Ordering::SeqCst);
    let other = world.builder("other");
    let fetched = other.pull(&graph, &store, &stop, &listener).expect("pulled");
    let fetching = most.swap(0, Ordering::SeqCst);
    assert!(payload(&other.cache) == world.whole && sent.moved == fetched.moved);
    for peak in [sending, fetching] {
        assert!((5..=32).contains(&peak), "{sending} requests at once to send, {fetching} to fetch");
    }
    // Each note has the number of artifacts so far, their total and the rate.
    let notes = notes.0.lock().expect("notes");
    let last = format!("({} of {}, ", sent.moved, sent.moved);
    let told = |verb: &str| notes.iter().filter(|text| text.starts_with(verb)).cloned().collect::<Vec<_>>();
    for texts in [told("sent "), told("fetched ")] {
        assert_eq!(texts.len(), sent.moved, "{texts:?}");
        assert!(texts.iter().any(|text| text.contains(&last)), "{texts:?}");
        assert!(texts.iter().all(|text| text.ends_with("/s)")), "{texts:?}");
    }
}

/// A store that is 20 ms away: nothing to do is found in seconds, because two lists say all names, however
/// many there are. Each list takes the time of twenty answers here. `USE3D_SCENES=500` makes 2,500 artifacts.
#[test]
fn nothing_to_do_is_found_soon_in_a_store_far_away() {
    let count = std::env::var("USE3D_SCENES").map_or(100, |n| n.parse().expect("a number of scenes"));
    let scenes: Vec<String> = (0..count).map(|n| format!("s{n}")).collect();
    let world = World::of(&scenes.iter().map(String::as_str).collect::<Vec<_>>());
    let requests = Arc::new(AtomicUsize::new(usize::MAX / 2));
    let counted = requests.clone();
    let remote = Arc::new(Faulty::new(move |doing, _| {
        // The first answers come at once, so that the store fills soon.
        if counted.fetch_add(1, Ordering::Relaxed) < usize::MAX / 2 {
            let answers = if doing == "list" { 20 } else { 1 };
            std::thread::sleep(answers * Duration::from_millis(20));
        }
        None
    }));
    let (store, alone) = (shared(&remote), world.builder("alone"));
    let sent = world.push(&alone, &store, false).expect("pushed");
    let names = remote.inner.objects().len();
    assert!(sent.moved >= 4 * count && names <= 40 * count, "{} artifacts, {names} names", sent.moved);
    requests.store(0, Ordering::Relaxed);
    let start = std::time::Instant::now();
    let again = world.push(&alone, &store, false).expect("pushed");
    let seconds = start.elapsed().as_secs_f64();
    let requests = requests.load(Ordering::Relaxed);
    println!("{} artifacts, nothing to do: {requests} lists, {seconds:.1} s", again.already);
    // Two lists of twenty answers take 0.8 s; the rest of the time is that of a plan on this machine.
    assert_eq!((again.moved, again.already, requests), (0, sent.moved, 2));
}
