//! `bench gpu --read`: what the file of a graphics card says, as a table and in words.
//!
//! The file is read field by field, because another version of the program may have written it, or the run
//! may have ended early. What is missing is left out.

use std::path::Path;

use serde_json::Value;
use use3d_capture::name::shown;

use use3d_pipeline::WorkError;

/// The `format` of such files.
pub(crate) const FORMAT: &str = "3d-use gpu bench";
/// Number of steps of stage 1 in the method.
const STEPS: f64 = 15_000.0;
/// The share of idle time above which the processor is what limits the steps.
const IDLE: f64 = 0.15;

/// Reads such a file; returns all lines of its report.
///
/// # Errors
/// Fails if the file cannot be read, or is of another kind.
pub fn read(path: &Path) -> Result<Vec<String>, WorkError> {
    let name = path.to_string_lossy();
    let name = shown(&name);
    let text = std::fs::read_to_string(path)
        .map_err(|error| WorkError::Input(format!("--read: cannot read {name}: {error}")))?;
    let other =
        |why: String| WorkError::Input(format!("--read: {name} is not a file of `use3d bench gpu`: {why}"));
    let record: Value = serde_json::from_str(&text).map_err(|error| other(error.to_string()))?;
    if record["format"] != FORMAT {
        return Err(other(format!("`format` is not \"{FORMAT}\"")));
    }
    Ok(report(&record))
}

fn text<'a>(value: &'a Value, missing: &'a str) -> &'a str {
    value.as_str().unwrap_or(missing)
}

fn list(value: &Value) -> &[Value] {
    value.as_array().map_or(&[], Vec::as_slice)
}

/// All lines: the card, the trainings with their kernels, and the verdict.
fn report(record: &Value) -> Vec<String> {
    let adapter = &record["adapter"];
    let (name, driver) =
        (text(&adapter["name"], "a card without a name"), text(&adapter["driver"], "no driver"));
    let kernels = text(&record["variant"], "unknown");
    let mut lines = vec![format!("{name} ({driver})"), format!("kernels: {kernels}")];
    lines.extend(compiled(record));
    for training in list(&record["trainings"]) {
        lines.push(String::new());
        lines.extend(of_training(training));
    }
    lines.push(String::new());
    lines.extend(verdict(record));
    // The text comes from a file of another machine.
    lines.iter_mut().for_each(|line| *line = shown(line).into_owned());
    lines
}

fn compiled(record: &Value) -> Option<String> {
    let kernels = record["compiled"].as_object().filter(|kernels| !kernels.is_empty())?;
    let milliseconds = |kernel: &Value| kernel["milliseconds"].as_f64().unwrap_or(0.0);
    let texts: f64 = kernels.values().filter_map(|kernel| kernel["texts"].as_f64()).sum();
    let all: f64 = kernels.values().map(milliseconds).sum();
    let slowest = kernels.iter().max_by(|a, b| milliseconds(a.1).total_cmp(&milliseconds(b.1)))?;
    let (name, slow) = (slowest.0, milliseconds(slowest.1));
    Some(format!("compiled {texts} texts in {all:.0} ms; the slowest is `{name}`, {slow:.0} ms"))
}

/// A kernel of a training: its name, its time in a step, and the least time for its work.
struct KernelTimes<'a> {
    name: &'a str,
    taken: f64,
    least: Option<f64>,
}

/// The kernels of a training, the slowest first.
fn kernels(training: &Value) -> Vec<KernelTimes<'_>> {
    let Some(kernels) = training["kernels"].as_object() else { return Vec::new() };
    // The profile has one of the last kernel per step.
    let steps = kernels.get("finish").and_then(|kernel| kernel["dispatches"].as_f64()).unwrap_or(1.0);
    let mut all: Vec<KernelTimes<'_>> = kernels
        .iter()
        .filter_map(|(name, kernel)| {
            let each = kernel["milliseconds"].as_f64()?;
            let taken = each * kernel["dispatches"].as_f64()? / steps.max(1.0);
            let least = training["roofline"][name]["least_milliseconds"].as_f64();
            Some(KernelTimes { name, taken, least })
        })
        .collect();
    all.sort_by(|a, b| b.taken.total_cmp(&a.taken));
    all
}

fn title(training: &Value) -> String {
    let size: Vec<String> = list(&training["size"]).iter().map(Value::to_string).collect();
    format!("{}, {} Gaussians", size.join(" x "), training["gaussians"])
}

/// The speed of a training, and the share of time in which the card was idle, if it is known.
pub(super) fn pace(title: &str, rate: f64, idle: Option<f64>) -> String {
    let idle = idle.map(|idle| format!(", {:.0} % of the time idle", 100.0 * idle)).unwrap_or_default();
    format!("{title}: {rate:.1} steps a second{idle}")
}

fn of_training(training: &Value) -> Vec<String> {
    let mut lines = Vec::new();
    match training["steps_per_second"].as_f64().filter(|rate| *rate > 0.0) {
        Some(rate) => lines.push(pace(&title(training), rate, training["idle_share"].as_f64())),
        None => lines.push(format!("{}: {}", title(training), text(&training["refusal"], "not finished"))),
    }
    let kernels = kernels(training);
    if !kernels.is_empty() {
        lines.push(format!("  {:<24} {:>10} {:>10} {:>7}", "kernel", "ms a step", "least ms", "share"));
    }
    for KernelTimes { name, taken, least } in kernels {
        let (least, share) = match least {
            Some(least) if taken > 0.0 => (format!("{least:.3}"), format!("{:.0} %", 100.0 * least / taken)),
            _ => ("-".into(), "-".into()),
        };
        lines.push(format!("  {name:<24} {taken:>10.3} {least:>10} {share:>7}"));
    }
    lines
}

/// The training with the most work that has a rate.
fn largest(record: &Value) -> Option<&Value> {
    let work = |training: &&Value| {
        let pixels: f64 = list(&training["size"]).iter().filter_map(Value::as_f64).product();
        pixels * training["gaussians"].as_f64().unwrap_or(0.0)
    };
    let all = list(&record["trainings"]).iter();
    all.filter(|training| training["steps_per_second"].as_f64().is_some_and(|rate| rate > 0.0))
        .max_by(|a, b| work(a).total_cmp(&work(b)))
}

/// Returns the verdict in sentences: the faults come first, and then the limits of the speed.
fn verdict(record: &Value) -> Vec<String> {
    let mut said = Vec::new();
    match record["check"]["passed"].as_bool() {
        Some(true) => {}
        Some(false) => said.push(format!(
            "The card did not pass its check, so no training uses it: {}.",
            text(&record["check"]["refusal"], "no reason is given")
        )),
        None => said.push("The run ended before the check was done.".into()),
    }
    let twins = list(&record["twins"]);
    let wrong: Vec<&Value> = twins.iter().filter(|twin| twin["holds"] == false).collect();
    for twin in wrong.iter().take(5) {
        let (what, case) = (text(&twin["what"], "?"), text(&twin["case"], "?"));
        // A file stores no number for an error that is not finite.
        let by =
            twin["error"].as_f64().map_or("a value that is not finite".into(), |error| error.to_string());
        let most = &twin["bar"];
        said.push(format!(
            "Wrong: {what} differ from the processor's by {by}, at most {most} is right ({case})."
        ));
    }
    if wrong.len() > 5 {
        said.push(format!("{} more comparisons do not hold.", wrong.len() - 5));
    }
    for runs in list(&record["determinism"]).iter().filter(|runs| runs["same"] == false) {
        let variant = text(&runs["variant"], "?");
        said.push(format!("Three runs of the same work gave different bits ({variant})."));
    }
    for failed in list(&record["failed"]) {
        said.push(format!("Failed: {}: {}.", text(&failed["section"], "?"), text(&failed["why"], "?")));
    }
    if said.is_empty() && twins.is_empty() {
        said.push("The card passed its check. The run ended before the comparisons.".into());
    } else if said.is_empty() {
        let closest = twins.iter().filter_map(|twin| Some(twin["error"].as_f64()? / twin["bar"].as_f64()?));
        let worst = closest.filter(|share| share.is_finite()).fold(0.0, f64::max);
        said.push(format!(
            "The card computes correctly: {} comparisons hold, the worst with {:.0} % of its tolerance.",
            twins.len(),
            100.0 * worst
        ));
    }
    said.extend(speed(record));
    if record["complete"] == false {
        said.push("The run was interrupted, so the file is not complete.".into());
    }
    let left_out: Vec<&str> = list(&record["left_out"]).iter().filter_map(Value::as_str).collect();
    if !left_out.is_empty() {
        said.push(format!("There was no time for: {} (`--minutes` gives more).", left_out.join("; ")));
    }
    said
}

fn speed(record: &Value) -> Vec<String> {
    let Some(training) = largest(record) else { return Vec::new() };
    let rate = training["steps_per_second"].as_f64().unwrap_or(1.0);
    let mut said = vec![format!(
        "At {} a step takes {:.2} ms, and {STEPS} steps take {:.0} s.",
        title(training),
        1e3 / rate,
        STEPS / rate
    )];
    if training["idle_share"].as_f64().is_some_and(|idle| idle > IDLE) {
        said.push("The card often waits for the processor, so a faster card would not help.".into());
    }
    let gain = |kernel: &KernelTimes<'_>| Some(kernel.taken - kernel.least?);
    let all = kernels(training);
    let total: f64 = all.iter().map(|kernel| kernel.taken).sum();
    let most = all
        .iter()
        .filter(|kernel| kernel.least.is_some())
        .max_by(|a, b| gain(a).unwrap_or(0.0).total_cmp(&gain(b).unwrap_or(0.0)));
    if let Some(kernel) = most {
        let (name, taken, least) = (kernel.name, kernel.taken, kernel.least.unwrap_or(0.0));
        said.push(format!(
            "Most can be gained in `{name}`: it takes {taken:.2} of {total:.2} ms, and its work needs at least {least:.2} ms."
        ));
    }
    let used = text(&record["variant"], "");
    let backward = training["backward_milliseconds"].as_object();
    let times = backward.into_iter().flatten().filter_map(|(name, time)| Some((name, time.as_f64()?)));
    if let Some((name, time)) = times.min_by(|a, b| a.1.total_cmp(&b.1))
        && !used.is_empty()
        && !used.starts_with(name.as_str())
    {
        said.push(format!("The backward pass is fastest with {name} ({time:.2} ms); trainings use {used}."));
    }
    said
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn record() -> Value {
        json!({
            "format": FORMAT,
            "adapter": { "name": "Card", "driver": "d 1" },
            "variant": "subgroups of 32",
            "check": { "passed": true },
            "compiled": { "update": { "texts": 1, "milliseconds": 30.0 }, "forward": { "texts": 6, "milliseconds": 90.0 } },
            "twins": [{ "what": "loss", "case": "c", "error": 1e-7, "bar": 1e-5, "holds": true }],
            "determinism": [{ "variant": "portable", "same": true }],
            "trainings": [
                { "size": [64, 48], "gaussians": 10, "steps_per_second": 900.0 },
                {
                    "size": [1400, 933], "gaussians": 500000, "steps_per_second": 250.0, "idle_share": 0.2,
                    "kernels": {
                        "finish": { "dispatches": 20, "milliseconds": 0.01 },
                        "forward": { "dispatches": 20, "milliseconds": 0.5 },
                        "pool": { "dispatches": 40, "milliseconds": 0.1 },
                        "backward": { "dispatches": 20, "milliseconds": 1.5 }
                    },
                    "roofline": {
                        "forward": { "least_milliseconds": 0.4 },
                        "backward": { "least_milliseconds": 0.5 }
                    },
                    "backward_milliseconds": { "portable": 3.0, "subgroups of 32, 4 pixels a thread": 1.2 }
                }
            ],
            "failed": [],
            "left_out": ["times at 64 x 48"],
            "complete": true
        })
    }

    #[test]
    fn a_good_card_is_described_with_its_kernels_and_its_limits() {
        let said = report(&record()).join("\n");
        for part in [
            "compiled 7 texts in 120 ms; the slowest is `forward`, 90 ms",
            "1400 x 933, 500000 Gaussians: 250.0 steps a second, 20 % of the time idle",
            "  backward                      1.500      0.500    33 %",
            "  pool                          0.200          -       -",
            "The card computes correctly: 1 comparisons hold, the worst with 1 % of its tolerance.",
            "a step takes 4.00 ms, and 15000 steps take 60 s",
            "waits for the processor",
            "Most can be gained in `backward`: it takes 1.50 of 2.21 ms",
            "fastest with subgroups of 32, 4 pixels a thread (1.20 ms)",
            "There was no time for: times at 64 x 48",
        ] {
            assert!(said.contains(part), "{part}\n{said}");
        }
    }

    #[test]
    fn what_is_wrong_comes_first() {
        let mut bad = record();
        bad["check"] = json!({ "passed": false, "refusal": "slopes differ" });
        bad["twins"][0]["holds"] = json!(false);
        bad["determinism"][0]["same"] = json!(false);
        bad["failed"] = json!([{ "section": "times", "why": "the device was lost" }]);
        bad["complete"] = json!(false);
        let said = verdict(&bad);
        assert!(said[0].contains("did not pass its check") && said[0].contains("slopes differ"), "{said:?}");
        assert!(said[1].starts_with("Wrong: loss") && said[2].contains("different bits"), "{said:?}");
        assert!(said[3].contains("the device was lost"), "{said:?}");
        assert!(said.iter().any(|line| line.contains("not complete")), "{said:?}");
        assert!(!said.iter().any(|line| line.contains("correctly")), "{said:?}");
    }

    #[test]
    fn nothing_is_called_correct_that_was_not_compared() {
        let mut early = record();
        early["twins"] = json!([]);
        let said = verdict(&early);
        assert!(said[0].contains("ended before the comparisons"), "{said:?}");
        assert!(!said.iter().any(|line| line.contains("correctly")), "{said:?}");
        let mut broken = record();
        broken["twins"][0] =
            json!({ "what": "loss", "case": "c", "error": null, "bar": 1e-5, "holds": false });
        assert!(verdict(&broken)[0].contains("a value that is not finite"), "{:?}", verdict(&broken));
    }

    #[test]
    fn a_file_that_ends_early_is_read_as_far_as_it_goes() {
        let said = report(&json!({ "format": FORMAT, "adapter": { "name": "Card\u{1b}[2J" } })).join("\n");
        assert!(
            said.contains("Card\\u{1b}[2J (no driver)") && said.contains("ended before the check"),
            "{said}"
        );
    }
}
