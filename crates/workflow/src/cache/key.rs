//! The key of an artifact: it covers everything that may change the artifact's bytes, and nothing else.
//!
//! key = BLAKE3(stage name, artifact schema ‖ code ‖ third-party versions ‖ canonical parameters ‖ seed ‖
//! numeric class ‖ content digests of the inputs by role). It never covers paths, times, hosts or thread
//! counts. The ingredients are kept in readable form beside every artifact, so that two keys can be compared
//! field by field.

use std::collections::{BTreeMap, BTreeSet};

use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::cache::{canonical, joined};
use use3d_code::digest::{Digest, Encoder};

/// Schema number of the encoding below; a change makes every artifact stale.
const CONTEXT: &str = "use3d 2026 artifact key v1";
const CHECKPOINT_CONTEXT: &str = "use3d 2026 checkpoint key v1";

/// The key of an artifact.
pub type Key = Digest;

/// One input of a stage in the key: its role and its content.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub struct InputDigest {
    /// The role of the input in the stage.
    pub role: String,
    /// The scene it comes from; for a stage over all scenes.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub scene: String,
    /// The scene's group; for a stage over all scenes.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub group: String,
    /// The variant it comes from; for a stage over all scenes.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub variant: String,
    /// Digest of its content.
    pub digest: Digest,
}

impl InputDigest {
    /// Role, scene and variant, for display.
    pub fn label(&self) -> String {
        let place = joined(&[&self.scene, &self.variant], ", ");
        if place.is_empty() { self.role.clone() } else { format!("{} of {place}", self.role) }
    }
}

/// All ingredients of a key.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Ingredients {
    /// The stage's name.
    pub stage: String,
    /// Schema number of the stage's artifact.
    pub version: u32,
    /// Token digests of the crates and files whose code the stage depends on.
    pub code: BTreeMap<String, Digest>,
    /// Versions and checksums of the third-party crates that this code uses.
    pub third_party: BTreeMap<String, String>,
    /// The stage's parameters, defaults filled in.
    pub parameters: Value,
    /// The seed, for a stage that draws random numbers.
    pub seed: Option<u64>,
    /// The class of arithmetic: the machine's, see [`numeric_class`], and the [device's](DeviceClass) where
    /// the stage computes on one.
    pub numeric_class: String,
    /// The inputs, sorted.
    pub inputs: Vec<InputDigest>,
    /// Inputs that could not be made; for a stage over all scenes.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub missing: Vec<String>,
}

impl Ingredients {
    /// The key.
    pub fn key(&self) -> Key {
        self.digest(CONTEXT, &self.parameters)
    }

    /// The key of the chain of checkpoints: like [`key`](Self::key), but without the parameters that only set
    /// the length of the work.
    pub fn checkpoint_key(&self, length_like: &[&str]) -> Digest {
        let mut parameters = self.parameters.clone();
        length_like.iter().for_each(|path| canonical::remove(&mut parameters, path));
        self.digest(CHECKPOINT_CONTEXT, &parameters)
    }

    fn digest(&self, context: &str, parameters: &Value) -> Digest {
        let mut encoder = Encoder::new(context);
        encoder.text(&self.stage).number(u64::from(self.version));
        encoder.number(self.code.len() as u64);
        for (name, digest) in &self.code {
            encoder.text(name).bytes(digest.as_bytes());
        }
        encoder.number(self.third_party.len() as u64);
        for (name, version) in &self.third_party {
            encoder.text(name).text(version);
        }
        canonical::encode(parameters, &mut encoder);
        encoder.number(u64::from(self.seed.is_some())).number(self.seed.unwrap_or(0));
        encoder.text(&self.numeric_class);
        encoder.number(self.inputs.len() as u64);
        let mut inputs: Vec<&InputDigest> = self.inputs.iter().collect();
        inputs.sort();
        for input in inputs {
            encoder.text(&input.role).text(&input.scene).text(&input.group).text(&input.variant);
            encoder.bytes(input.digest.as_bytes());
        }
        encoder.number(self.missing.len() as u64);
        for name in &self.missing {
            encoder.text(name);
        }
        encoder.finish()
    }

    /// Lists the differences between an earlier record (`self`) and `now`, field by field, in a fixed order.
    pub fn differences(&self, now: &Self) -> Vec<Difference> {
        let mut out = Vec::new();
        for (old, new) in self.texts().iter().zip(&now.texts()) {
            for name in old.keys().chain(new.keys()).collect::<BTreeSet<_>>() {
                let (old, new) = (old.get(name).cloned(), new.get(name).cloned());
                if old != new {
                    out.push(Difference { ingredient: name.clone(), old, new });
                }
            }
        }
        out
    }

    /// The ingredients as texts by name, kind by kind.
    fn texts(&self) -> [BTreeMap<String, String>; 8] {
        let one =
            |name: &str, text: Option<String>| text.map(|t| (name.to_string(), t)).into_iter().collect();
        let parameters = canonical::leaves(&self.parameters).into_iter();
        [
            one("artifact schema", Some(self.version.to_string())),
            self.code.iter().map(|(name, digest)| (format!("code {name}"), digest.short())).collect(),
            self.third_party
                .iter()
                .map(|(name, v)| (format!("third-party crate {name}"), v.clone()))
                .collect(),
            parameters.map(|(name, v)| (format!("parameter {name}"), canonical::display(v))).collect(),
            one("seed", self.seed.map(|seed| seed.to_string())),
            one("numeric class", Some(self.numeric_class.clone())),
            self.inputs.iter().map(|i| (format!("input {}", i.label()), i.digest.short())).collect(),
            one("missing inputs", Some(self.missing.join(", ")).filter(|_| !self.missing.is_empty())),
        ]
    }
}

/// One ingredient that changed.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Difference {
    /// The name of the ingredient, e.g. `parameter iterations` or `input scene`.
    pub ingredient: String,
    /// Its earlier value; absent when it is new.
    pub old: Option<String>,
    /// Its value now; absent when it was removed.
    pub new: Option<String>,
}

impl std::fmt::Display for Difference {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let show = |value: &Option<String>| match value.as_deref() {
            Some("null") => "not set".to_string(),
            Some(value) => value.to_string(),
            None => "(none)".to_string(),
        };
        write!(f, "{}: {} → {}", self.ingredient, show(&self.old), show(&self.new))
    }
}

/// The class of arithmetic of this machine: within one class a stage's bytes are the same on every machine.
///
/// A fused multiply-add rounds once; a separate multiplication and addition round twice. So architecture,
/// operating system and FMA define the class. The number of lanes does not, and neither does the C library,
/// because it computes nothing (`use3d_numerics::math`).
pub fn numeric_class() -> String {
    let arch = std::env::consts::ARCH;
    let os = std::env::consts::OS;
    #[cfg(any(target_arch = "x86", target_arch = "x86_64"))]
    let fused = std::arch::is_x86_feature_detected!("fma") && std::arch::is_x86_feature_detected!("avx2");
    #[cfg(not(any(target_arch = "x86", target_arch = "x86_64")))]
    let fused = cfg!(target_arch = "aarch64");
    format!("{arch}-{os}{}", if fused { "+fma" } else { "" })
}

/// The device that a stage computes with besides the processor, and the programs that run on it. Any of these
/// may change last bits.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct DeviceClass {
    /// The engine's name.
    pub engine: String,
    /// The device.
    pub adapter: String,
    /// Its driver, with its version.
    pub driver: String,
    /// Digest of the programs that run on it, in the form in which the driver gets them.
    pub kernels: Digest,
}

impl DeviceClass {
    /// The class of a stage that computes with this device on a machine of class `machine`.
    pub fn on(&self, machine: &str) -> String {
        let Self { engine, adapter, driver, kernels } = self;
        format!("{engine} on {adapter}, driver {driver}, kernels {kernels}; {machine}")
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn sample() -> Ingredients {
        let digest = Digest::of(b"a");
        Ingredients {
            stage: "reconstruct".to_string(),
            version: 1,
            code: BTreeMap::from([("use3d-splat".to_string(), digest)]),
            third_party: BTreeMap::from([("rayon".to_string(), "1.12.0 abc".to_string())]),
            parameters: json!({"iterations": 15000, "split": {"every": 8}}),
            seed: Some(42),
            numeric_class: "x86_64-linux+fma".to_string(),
            inputs: vec![InputDigest {
                role: "capture".to_string(),
                scene: String::new(),
                group: String::new(),
                variant: String::new(),
                digest,
            }],
            missing: Vec::new(),
        }
    }

    #[test]
    fn every_ingredient_changes_the_key_and_is_named() {
        let base = sample();
        type Change = (&'static str, fn(&mut Ingredients));
        let changes: [Change; 9] = [
            ("artifact schema", |i| i.version = 2),
            ("code use3d-splat", |i| *i.code.get_mut("use3d-splat").expect("there") = Digest::of(b"b")),
            ("third-party crate rayon", |i| {
                *i.third_party.get_mut("rayon").expect("there") = "1.13.0 d".to_string();
            }),
            ("parameter split.every", |i| i.parameters["split"]["every"] = json!(4)),
            ("parameter iterations", |i| i.parameters["iterations"] = json!(20000)),
            ("seed", |i| i.seed = Some(43)),
            ("numeric class", |i| i.numeric_class = "x86_64-linux".to_string()),
            ("input capture", |i| i.inputs[0].digest = Digest::of(b"b")),
            ("missing inputs", |i| i.missing.push("Panama".to_string())),
        ];
        let mut keys = vec![base.key()];
        for (name, change) in changes {
            let mut changed = base.clone();
            change(&mut changed);
            let key = changed.key();
            assert!(!keys.contains(&key), "{name} must change the key");
            keys.push(key);
            let differences = base.differences(&changed);
            assert_eq!(differences.len(), 1, "{name}: {differences:?}");
            assert_eq!(differences[0].ingredient, name);
        }
        assert_eq!(base.key(), sample().key());
        assert!(base.differences(&sample()).is_empty());
    }

    #[test]
    fn the_length_is_not_in_the_checkpoint_key() {
        let short = sample();
        let mut long = sample();
        long.parameters["iterations"] = json!(20000);
        assert_ne!(short.key(), long.key());
        assert_eq!(short.checkpoint_key(&["iterations"]), long.checkpoint_key(&["iterations"]));
        assert_ne!(short.checkpoint_key(&[]), long.checkpoint_key(&[]));
        assert_ne!(short.checkpoint_key(&["iterations"]), short.checkpoint_key(&["split.every"]));
        assert_ne!(short.key(), short.checkpoint_key(&[]));
    }
}
