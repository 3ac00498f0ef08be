use super::*;
use crate::cache::node::Clock;

fn foreign() -> Vec<u8> {
    let process = ProcessId { place: "elsewhere".to_string(), pid: 7, started: 1 };
    let host = "elsewhere".to_string();
    serde_json::to_vec(&Holder { process, host, token: String::new(), task: None, reads: Vec::new() })
        .unwrap()
}

fn granted(asked: &LeaseRequest) -> bool {
    matches!(asked, LeaseRequest::Granted(Some(_)))
}

fn set_time(path: &Path, time: SystemTime) {
    std::fs::File::options().write(true).open(path).and_then(|f| f.set_modified(time)).unwrap();
}

fn key_of(text: &str) -> Key {
    Digest::of(text.as_bytes())
}

#[test]
fn a_lease_is_judged_by_whether_it_changes_and_not_by_its_time() {
    let dir = tempfile::tempdir().unwrap();
    let cache = Cache::open(dir.path(), false).unwrap();
    let start = cache.node.clock.now();
    let hour = Duration::from_secs(3600);
    for (i, (bytes, limit)) in [(foreign(), EXPIRY), (Vec::new(), HALF)].into_iter().enumerate() {
        for (j, future) in [true, false].into_iter().enumerate() {
            let key = Digest::of(&[i as u8, j as u8]);
            let path = folder(&cache).join(key.to_string());
            let write = |beats: u32| {
                std::fs::write(&path, &bytes).unwrap();
                let now = SystemTime::now() + Duration::from_secs(u64::from(beats));
                set_time(&path, if future { now + hour } else { now - hour });
            };
            let ask = |after: Duration| Lease::ask_at(&cache, &key, &[], start + after);
            write(0);
            assert!(!granted(&ask(Duration::ZERO)), "it may be alive");
            // The lease changes: its holder is alive, even if the holder's clock is wrong.
            for beat in 1..4 {
                write(beat);
                assert!(!granted(&ask(limit * beat)), "{i} {future} {beat}");
            }
            assert!(!granted(&ask(limit * 3 + limit / 2)));
            let LeaseRequest::Granted(Some(lease)) = ask(limit * 4) else {
                panic!("it has not changed for long")
            };
            assert!(!lease.followed, "its holder was gone: nothing was published");
            lease.finish();
            assert!(!path.exists(), "given back");
        }
    }
}

/// Two users of one cache that cannot check each other's processes; the clock of the second is a year ahead
/// and runs twice as fast.
fn two(dir: &Path) -> [Cache; 2] {
    let year = Duration::from_secs(31_536_000);
    [("east", Clock::system()), ("west", Clock::other(year, 2.0))]
        .map(|(host, clock)| Cache::open(dir, false).unwrap().as_node(Node::elsewhere(host, clock)))
}

#[test]
fn what_happens_on_another_machine_shows_in_the_lease() {
    let dir = tempfile::tempdir().unwrap();
    let [east, west] = two(dir.path());
    let key = key_of("key");
    let at = |after: Duration| west.node.clock.now() + after;
    let ask = |after: Duration| Lease::ask_at(&west, &key, &[], after);
    let LeaseRequest::Granted(Some(lease)) = Lease::ask(&east, &key, &[]) else { panic!("nobody has it") };
    let start = at(Duration::ZERO);
    assert!(matches!(ask(start), LeaseRequest::Held(name) if name.contains("east")));

    // The pulse alone keeps the lease, and reports the progress of the work; the file's time does not matter.
    let progress = Progress::default();
    for beat in 1..6 {
        progress.note(u64::from(beat) * 100, 15_000, "steps");
        lease.renew(&progress);
        set_time(&lease.path, SystemTime::UNIX_EPOCH);
        assert!(matches!(ask(start + EXPIRY * beat), LeaseRequest::Held(_)), "{beat}");
    }
    let told = west.working_on(&key).expect("somebody does");
    assert_eq!(
        (told.host.as_str(), told.done, told.total, told.unit.as_str()),
        ("east", 500, 15_000, "steps")
    );

    // The holder gave up: the lease can be taken at once, and nothing was published.
    drop(lease);
    assert!(west.working_on(&key).is_none());
    let LeaseRequest::Granted(Some(lease)) = ask(start + EXPIRY * 5) else { panic!("its holder gave up") };
    assert!(!lease.followed);
    assert!(matches!(Lease::ask(&east, &key, &[]), LeaseRequest::Held(name) if name.contains("west")));
    // Published: the other user knows that there is an artifact to see.
    lease.finish();
    let LeaseRequest::Granted(Some(lease)) = Lease::ask(&east, &key, &[]) else { panic!("nobody has it") };
    assert!(lease.followed);
    // It does not happen again for the same key.
    lease.finish();
    assert!(matches!(Lease::ask(&east, &key, &[]), LeaseRequest::Granted(Some(lease)) if !lease.followed));
}

#[test]
fn a_holder_that_was_taken_for_gone_does_not_disturb_the_next() {
    let dir = tempfile::tempdir().unwrap();
    let [east, west] = two(dir.path());
    let key = key_of("key");
    let LeaseRequest::Granted(Some(stopped)) = Lease::ask(&east, &key, &[]) else { panic!("nobody has it") };
    let now = west.node.clock.now();
    assert!(matches!(Lease::ask_at(&west, &key, &[], now), LeaseRequest::Held(_)));
    let LeaseRequest::Granted(Some(next)) = Lease::ask_at(&west, &key, &[], now + EXPIRY) else {
        panic!("it has not changed")
    };
    let bytes = std::fs::read(&next.path).unwrap();
    stopped.renew(&Progress::default());
    drop(stopped);
    assert_eq!(std::fs::read(&next.path).unwrap(), bytes);
    next.finish();
    assert_eq!(std::fs::read_dir(folder(&east)).unwrap().count(), 0);
}

#[test]
fn of_many_that_take_over_one_gets_it() {
    let dir = tempfile::tempdir().unwrap();
    let cache = Cache::open(dir.path(), false).unwrap();
    let key = key_of("key");
    let gone = ProcessId { started: ProcessId::this().started + 1, ..ProcessId::this() };
    if gone.is_alive() != Some(false) {
        return; // a system that does not report it
    }
    let dead = Holder { process: gone, ..Holder::of(&Node::this(), Vec::new()) };
    for _ in 0..20 {
        let path = folder(&cache).join(key.to_string());
        std::fs::write(&path, serde_json::to_vec(&dead).unwrap()).unwrap();
        let asked: Vec<LeaseRequest> = std::thread::scope(|scope| {
            let all: Vec<_> = (0..4).map(|_| scope.spawn(|| Lease::ask(&cache, &key, &[]))).collect();
            all.into_iter().map(|one| one.join().unwrap()).collect()
        });
        assert!(asked.iter().filter(|a| granted(a)).count() <= 1);
        let later = Lease::ask(&cache, &key, &[]);
        let mut all: Vec<LeaseRequest> = asked.into_iter().chain([later]).filter(granted).collect();
        assert_eq!(all.len(), 1);
        let Some(LeaseRequest::Granted(Some(lease))) = all.pop() else { panic!("one has it") };
        lease.finish();
    }
    assert_eq!(std::fs::read_dir(folder(&cache)).unwrap().count(), 0);
}

#[test]
fn a_run_protects_what_it_has_decided_on() {
    let dir = tempfile::tempdir().unwrap();
    let [cache, other] = two(dir.path());
    let mut run = RunLease::new(&cache);
    for (i, text) in ["a", "b"].into_iter().enumerate() {
        run.extend([key_of(text)]);
        run.show();
        // It does not matter by how much the two clocks differ.
        assert_eq!((in_use(&cache).len(), in_use(&other).len()), (i + 1, i + 1));
    }
    drop(run);
    assert!(in_use(&cache).is_empty());
    // Many keys are added one after the other. Every key is seen; there are few files, and each key is
    // written only a few times.
    let mut run = RunLease::new(&cache);
    let mut written = 0;
    for i in 1..2000_usize {
        run.extend([key_of(&i.to_string())]);
        run.show();
        let size = |part: &LeaseFile| std::fs::metadata(&part.path).unwrap().len() as usize;
        written += run.parts.last().map_or(0, size);
        assert!(run.parts.len() <= 2 + i.ilog2().saturating_sub(5) as usize, "{}", run.parts.len());
        if i % 500 == 0 {
            assert_eq!(in_use(&other).len(), i);
        }
    }
    assert!(written / 2000 < 8000, "{} bytes a key", written / 2000);
    assert_eq!(in_use(&other).len(), 1999);
    drop(run);
    assert!(in_use(&cache).is_empty() && std::fs::read_dir(folder(&cache)).unwrap().count() == 0);
    // A lease of another machine, read only once, counts as live unless it is more than a day old.
    let path = folder(&cache).join(key_of("c").to_string());
    std::fs::write(&path, foreign()).unwrap();
    assert_eq!(in_use(&cache).len(), 1);
    set_time(&path, SystemTime::now() + 2 * LONG_GONE);
    assert!(in_use(&cache).is_empty() && !path.exists());
}

#[test]
fn waiting_grows_to_five_seconds_and_differs_between_processes() {
    let of = |number: u64| (0..40).map(|times| back_off(times, number)).collect::<Vec<_>>();
    for waits in [of(0), of(u64::MAX), of(0x0123_4567_89ab_cdef)] {
        assert!(waits[0] >= Duration::from_millis(30) && waits[0] <= Duration::from_millis(80), "{waits:?}");
        let last = waits[39];
        assert!(last >= Duration::from_millis(3500) && last <= Duration::from_millis(6500), "{waits:?}");
    }
    assert_ne!(of(1), of(2 << 40));
}

/// After a kill, the next request starts the count of unchanged time, and the first request after the limit
/// takes the lease over. So the wait is at most the limit and two pauses.
#[test]
fn the_work_of_a_killed_process_goes_on_soon() {
    let longest = (0..256).map(|number| back_off(40, number << 40)).max().unwrap().max(LONGEST_PAUSE);
    assert!(ASKING + 2 * longest <= Duration::from_secs(30), "a scheduler reports the end");
    assert!(EXPIRY + 2 * longest <= Duration::from_secs(120), "nobody reports the end");
}

#[test]
fn a_task_that_is_known_to_be_over_is_waited_for_no_longer_and_how_it_ended_is_kept() {
    let dir = tempfile::tempdir().unwrap();
    let task = ClusterTask {
        scheduler: "slurm".to_string(),
        cluster: String::new(),
        id: "12_4".to_string(),
        attempt: 0,
        memory: 900 << 20,
        submission: String::new(),
    };
    let open = || Cache::open(dir.path(), false).unwrap();
    let elsewhere = |host: &str| Node::elsewhere(host, Clock::system());
    let over = std::sync::Arc::new(std::sync::atomic::AtomicBool::new(false));
    let answer = over.clone();
    let [silent, asking] = [(); 2].map(|()| open().as_node(elsewhere("west")));
    let asking = asking.asking(std::sync::Arc::new(move |asked: &ClusterTask| {
        assert_eq!(asked.id, "12_4");
        Some(answer.load(std::sync::atomic::Ordering::Relaxed))
    }));
    let killed = |key: &Key| {
        let cache = open().as_node(Node { task: Some(task.clone()), ..elsewhere("n1") });
        let LeaseRequest::Granted(Some(lease)) = Lease::ask(&cache, key, &[]) else {
            panic!("nobody has it")
        };
        let progress = Progress::default();
        progress.note_memory(3 << 30);
        lease.renew(&progress);
        std::mem::forget(lease); // it ends without a word
    };
    let now = asking.node.clock.now();
    // The scheduler has the task at first, and later no longer.
    let key = key_of("first");
    killed(&key);
    let ask = |after| Lease::ask_at(&asking, &key, &[], now + after);
    assert!(!granted(&ask(Duration::ZERO)) && !granted(&ask(ASKING)));
    over.store(true, std::sync::atomic::Ordering::Relaxed);
    assert!(granted(&ask(ASKING)), "taken over");
    let known = silent.killed(&key).unwrap();
    assert_eq!((known.host.as_str(), known.times, known.peak_memory), ("n1", 1, 3 << 30));
    assert_eq!(known.asks_for(), (3 << 30) + (3 << 29));
    assert!(known.to_string().contains("slurm 12_4 ended without a word"), "{known}");
    // A process without a scheduler to ask waits until the lease expires, and not longer.
    let key = key_of("second");
    killed(&key);
    let ask = |after| Lease::ask_at(&silent, &key, &[], now + after);
    assert!(!granted(&ask(Duration::ZERO)) && !granted(&ask(ASKING)) && granted(&ask(EXPIRY)));
    assert!(EXPIRY < PATIENCE, "a run that waits for others outlives the lease of one that was killed");
    // A later attempt of the same task does not wait at all.
    let key = key_of("third");
    killed(&key);
    let later =
        open().as_node(Node { task: Some(ClusterTask { attempt: 1, ..task.clone() }), ..elsewhere("n2") });
    assert!(granted(&Lease::ask(&later, &key, &[])));
    // A holder that gives up was not killed.
    let key = key_of("fourth");
    let LeaseRequest::Granted(lease) = Lease::ask(&later, &key, &[]) else { panic!("nobody has it") };
    drop(lease);
    assert!(granted(&Lease::ask(&silent, &key, &[])) && silent.killed(&key).is_none());
}
