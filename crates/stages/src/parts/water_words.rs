//! The water of a scene in sentences, and its attenuation, as a report shows them.

use std::path::Path;

use serde_json::Value;
use use3d_capture::shown;
use use3d_numerics::math;
use use3d_scene::Scene;

use crate::parts::files::{CHOICES, WATER, read_json};
use crate::reconstruct::Choices;

/// A sentence on the water of stage 1, in the same words as `use3d water` if the tracks were used, and one on
/// the metres of a unit. Empty if the scene does not say it.
pub(crate) fn water_sentences(scene: &Path) -> String {
    let estimate: Option<Value> = read_json(&scene.join(WATER)).ok();
    let water = estimate.as_ref().and_then(water_from_tracks).unwrap_or_else(|| {
        let water = read_json::<Choices>(&scene.join(CHOICES)).unwrap_or_default().water;
        if water.is_empty() { water } else { format!("{}.", capitalised(&water)) }
    });
    [water, scale_sentence(scene, estimate.as_ref())].join(" ").trim().to_string()
}

/// The attenuation of each colour, and true if it is per metre; `None` if the tracks do not tell it in every
/// colour.
pub(crate) fn attenuation(scene: &Path) -> Option<([f64; 3], bool)> {
    let water: Value = read_json(&scene.join(WATER)).ok()?;
    let each = |of: &dyn Fn(usize) -> Option<f64>| Some([of(0)?, of(1)?, of(2)?]);
    let in_metres = each(&|c| water["metric"]["attenuation"][c]["value"].as_f64());
    let in_units = each(&|c| water["channels"][c]["attenuation"]["value"].as_f64());
    let known = in_metres.map(|values| (values, true)).or_else(|| Some((in_units?, false)));
    known.filter(|_| water["judgement"] == "found")
}

/// A sentence on the metres of a unit; empty if they are not known and nothing is told in units.
fn scale_sentence(scene: &Path, estimate: Option<&Value>) -> String {
    let world = match Scene::world(scene) {
        Ok(Some(world)) => world,
        Ok(None) if estimate.is_some() => {
            return "The scene has no metres; give one known length to get them.".into();
        }
        _ => return String::new(),
    };
    let attenuation = estimate.and_then(|water| water["metric"]["attenuation"].as_array());
    let per_metre = attenuation.map_or_else(String::new, |values| {
        let values: Vec<String> = values.iter().map(|v| number(&v["value"], 3)).collect();
        format!(" Attenuation per metre, red, green, blue: {}.", values.join(", "))
    });
    format!("One unit is {:.4} m, by {}.{per_metre}", world.metres_per_unit, shown(&world.source))
}

/// The water estimated from the tracks; `None` for an estimate of another form.
fn water_from_tracks(water: &Value) -> Option<String> {
    let told = capitalised(water["told"].as_str()?);
    let (judgement, used) = match water["judgement"] == "found" {
        true => {
            ("The water was measured", "So much of each colour is lost along one unit of the scene's length.")
        }
        false => {
            (&*told, "These losses along one unit of the scene's length are not certain and are not used.")
        }
    };
    let channels: Vec<(String, &str)> = water["channels"].as_array()?.iter().map(channel_in_words).collect();
    if channels.is_empty() {
        return None;
    }
    // Neighbouring channels with the same verdict share a sentence.
    let alike = channels.chunk_by(|(_, one), (_, other)| one == other);
    let sentences = alike.map(|channels| {
        let figures: Vec<&str> = channels.iter().map(|(figures, _)| &figures[..]).collect();
        format!("{} ({}).", capitalised(&figures.join(", ")), channels[0].1)
    });
    Some(format!("{judgement}. {used} {}", sentences.collect::<Vec<_>>().join(" ")))
}

/// A channel's attenuation with its error, and its verdict.
fn channel_in_words(channel: &Value) -> (String, &str) {
    let name = channel["channel"].as_str().unwrap_or_default();
    let known = channel["attenuation"]["value"].as_f64().zip(channel["attenuation"]["error"].as_f64());
    let lost = known.map_or_else(String::new, |(value, error)| {
        let left = 100.0 * math::exp(-value);
        format!(" {:.1} ± {:.1} %", 100.0 - left, left * error)
    });
    let told = match channel["verdict"].as_str() {
        Some("found") => "measured",
        Some("veil-not-separable") => "the loss was measured, and the haze is a guess",
        _ => channel["told"].as_str().unwrap_or_default(),
    };
    (format!("{name}{lost}"), told)
}

fn number(value: &Value, decimals: usize) -> String {
    value.as_f64().map_or_else(|| "–".into(), |value| format!("{value:.decimals$}"))
}

fn capitalised(text: &str) -> String {
    let mut chars = text.chars();
    chars.next().map_or_else(String::new, |first| first.to_uppercase().chain(chars).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn channels_with_the_same_verdict_share_a_sentence() {
        let channel = |name: &str, told: &str| {
            serde_json::json!({
                "channel": name, "told": told, "attenuation": {"value": 0.03, "error": 0.004}
            })
        };
        let mut water = serde_json::json!({
            "told": "water known in red", "judgement": "partly",
            "channels": [channel("red", "found"), channel("green", "unseen"), channel("blue", "unseen")],
        });
        assert_eq!(
            water_from_tracks(&water).expect("an estimate"),
            "Water known in red. These losses along one unit of the scene's length are not certain and are not used. Red \
             3.0 ± 0.4 % (found). Green 3.0 ± 0.4 %, blue 3.0 ± 0.4 % (unseen)."
        );
        water["channels"] = serde_json::json!([]);
        assert_eq!(water_from_tracks(&water), None);
    }
}
