use super::*;

/// The stages of a default run.
const STAGES: [&str; 7] = ["import", "reconstruct", "targets", "enhance", "render", "evaluate", "report"];

fn default_run(started: Instant) -> WholeRun {
    let registry = use3d_stages::registry().expect("the stages");
    let part = |stage| {
        let stage = registry.stage(stage).expect("a stage");
        let parameters = stage.parameters(&serde_json::json!({})).expect("defaults");
        Share { cost: stage.usual_cost(&parameters), forecast: None, turn: Turn::Pending, needs: Vec::new() }
    };
    WholeRun {
        parts: STAGES.map(part).to_vec(),
        total: STAGES.len(),
        jobs: 1,
        started,
        drawn: None,
        shown: 0,
    }
}

fn after(start: Instant, seconds: f64) -> Instant {
    start + Duration::from_secs_f64(seconds)
}

/// The times of a recorded run at which the bar moves, in seconds, with the seconds left that it shows, and
/// the duration of the run.
fn replay(lines: &[&str]) -> (Vec<(f64, f64)>, f64) {
    let start = Instant::now();
    let mut whole = default_run(start);
    let (mut begun, mut shown) = (0.0, Vec::new());
    for line in lines {
        let words: Vec<&str> = line.split(' ').collect();
        let stage = STAGES.iter().position(|stage| *stage == words[0]).expect("a stage");
        let number = |i: usize| words[i].parse::<f64>().expect("a number");
        let passed = if words[1] == "done" {
            whole.parts[stage].turn = Turn::Over(number(2));
            begun += number(2);
            begun
        } else {
            let now = after(start, begun + number(1));
            whole.parts[stage].turn = told(after(start, begun), None, Some(number(2)), now);
            begun + number(1)
        };
        shown.extend(whole.left(after(start, passed)).map(|left| (passed, left)));
    }
    (shown, begun)
}

#[test]
fn after_a_fifth_of_a_first_run_the_time_left_is_right_to_a_factor_of_two() {
    let recorded = include_str!("recorded.txt");
    let runs = recorded.lines().filter(|line| !line.starts_with('#')).collect::<Vec<_>>().join("\n");
    let runs: Vec<&str> = runs.split("run ").skip(1).collect();
    assert_eq!(runs.len(), 3);
    for run in runs {
        let lines: Vec<&str> = run.lines().collect();
        let (shown, total) = replay(&lines[1..]);
        let checked: Vec<_> = shown.iter().filter(|(t, _)| (0.2 * total..0.97 * total).contains(t)).collect();
        assert!(checked.len() > 15, "{}: {} estimates", lines[0], checked.len());
        for (passed, left) in checked {
            let ratio = left / (total - passed);
            assert!((0.5..2.0).contains(&ratio), "{}: {passed} of {total} s: {left} s left", lines[0]);
        }
    }
}

#[test]
fn a_failed_stage_takes_those_that_need_it_away() {
    let start = Instant::now();
    let mut whole = default_run(start);
    whole.parts.iter_mut().for_each(|part| part.forecast = Some(10.0));
    // The targets need stage 1, stage 2 needs the targets, and the others need nothing here.
    (whole.parts[2].needs, whole.parts[3].needs) = (vec![0, 1], vec![2]);
    whole.give_up(1);
    assert_eq!(whole.left(start), Some(40.0));
}

#[test]
fn a_log_without_a_bar_hears_how_many_stages_are_over() {
    let told: Arc<Mutex<Vec<(usize, usize)>>> = Arc::default();
    let heard = told.clone();
    let inner: Arc<dyn Listener> = Arc::new(move |event: &Event<'_>| {
        if let Event::Counted { done, total } = event {
            heard.lock().expect("told").push((*done, *total));
        }
    });
    let mut whole = default_run(Instant::now());
    // The targets need stage 1, and stage 2 needs the targets: both are over if it fails.
    (whole.parts[2].needs, whole.parts[3].needs) = (vec![0, 1], vec![2]);
    let listener = whole.listener(inner);
    listener.event(&Event::Done { node: 0, label: "", cached: false, seconds: 1.0 });
    listener.event(&Event::Failed { node: 1, label: "", reason: "", log: std::path::Path::new("") });
    listener.event(&Event::Done { node: 4, label: "", cached: true, seconds: 0.0 });
    listener.event(&Event::Done { node: 5, label: "", cached: false, seconds: 1.0 });
    assert_eq!(*told.lock().expect("told"), [(1, 7), (4, 7), (6, 7)]);
}

#[test]
fn a_pause_of_the_process_is_not_taken_for_work() {
    let start = Instant::now();
    let mut whole = default_run(start);
    let mut turn = Turn::Running(start, None);
    let mut report = |seconds: f64, left: f64| {
        let Turn::Running(began, before) = turn else { return };
        turn = told(began, before, Some(left), after(start, seconds));
    };
    for k in 1..=20 {
        report(f64::from(k), f64::from(100 - k));
    }
    // The notebook was closed for ten minutes; then the work goes on as before.
    report(621.0, 79.0);
    report(622.0, 78.0);
    whole.parts[1].turn = turn;
    let now = after(start, 622.0);
    let seconds = whole.parts[1].whole(now).expect("a running stage");
    assert!((seconds - 100.0).abs() < 2.0, "{seconds}");
    // A pause before the first word, or one long step of many, is work.
    assert_eq!(
        told(start, None, Some(5.0), now),
        Turn::Running(start, Some(Told { left: 5.0, at: now, since: now - start }))
    );
}

#[test]
fn forecasts_count_before_usual_costs_and_jobs_share_the_work() {
    let start = Instant::now();
    let mut whole = default_run(start);
    assert_eq!(whole.left(start), None, "nothing is known yet");
    for part in &mut whole.parts {
        part.forecast = Some(10.0);
    }
    assert_eq!(whole.left(start), Some(70.0));
    whole.jobs = 2;
    assert_eq!(whole.left(start), Some(35.0));
    whole.parts[1].forecast = Some(100.0);
    assert_eq!(whole.left(start), Some(100.0), "one stage runs in one job");
    // A running stage without news uses up its forecast, and no more.
    whole.parts[1].turn = Turn::Running(start, None);
    assert_eq!(whole.left(after(start, 60.0)), Some(50.0));
    assert_eq!(whole.left(after(start, 500.0)), Some(30.0));
    whole.parts.iter_mut().for_each(|part| part.turn = Turn::Over(1.0));
    assert_eq!(whole.left(start), Some(0.0));
}
