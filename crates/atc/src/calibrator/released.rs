//! Reads the calibrator that the paper's authors released, `transition_calibrator.pth`.
//!
//! Its archive holds a schema name and version (5) beside a state dictionary. The dictionary has two heads
//! (`global_head`, `local_head`) with linear layers at positions 0, 2 and 4, and medians and scales of
//! operators and conditions. This module receives the named tensors; it does not read the archive. The
//! calibrator is in `linear` form (R16): the first three local numbers are gains minus one, and all later
//! steps use that form.

use std::collections::BTreeMap;

use super::{Calibrator, GLOBAL_CONDITION, Head, LOCAL_CONDITION, Linear, Mlp, Provenance, Statistics};
use crate::error::AtcError;
use crate::extractor::{ExtractorSettings, Form};
use crate::proposers::ProposerId;

const WHAT: &str = "released calibrator";
/// The schema name in the archive.
const SCHEMA: &str = "3duse_transition_calibrator";
/// The schema version that can be read.
const SCHEMA_VERSION: i64 = 5;

/// The settings in the archive beside its tensors, and those that it does not contain.
#[derive(Clone, Debug, PartialEq)]
pub struct ReleasedConfig {
    /// The archive's `schema`; empty if it was not read.
    pub schema: String,
    /// The archive's `schema_version`.
    pub schema_version: i64,
    /// The proposer for which it was fitted; `nu2net` with an empty digest if the archive does not contain
    /// it.
    pub proposer: ProposerId,
    /// Extractor settings; the authors use scenes at a long side of 384 with 16 cells, in linear form.
    pub extractor: ExtractorSettings,
}

impl Default for ReleasedConfig {
    fn default() -> Self {
        Self {
            schema: SCHEMA.into(),
            schema_version: SCHEMA_VERSION,
            proposer: ProposerId { name: "nu2net".into(), digest: String::new() },
            extractor: ExtractorSettings { form: Form::Linear, ..ExtractorSettings::default() },
        }
    }
}

fn wrong(problem: String) -> AtcError {
    AtcError::artifact(WHAT, problem)
}

type ReleasedTensors = BTreeMap<String, (Vec<usize>, Vec<f32>)>;

impl Calibrator {
    /// Makes a calibrator from the tensors of the released state dictionary. Names that contain `support_`
    /// are ignored. Any other tensor that is missing, unexpected, of a wrong shape or not finite is an
    /// error.
    pub fn from_named_tensors(
        mut tensors: ReleasedTensors,
        config: &ReleasedConfig,
    ) -> Result<Self, AtcError> {
        if !config.schema.is_empty() && config.schema != SCHEMA {
            return Err(wrong(format!("its schema is `{}`, expected `{SCHEMA}`", config.schema)));
        }
        if config.schema_version != SCHEMA_VERSION {
            return Err(wrong(format!(
                "its schema version is {}, only {SCHEMA_VERSION} is read",
                config.schema_version
            )));
        }
        if config.extractor.form != Form::Linear {
            return Err(AtcError::Form);
        }
        config.extractor.validate()?;
        tensors.retain(|name, _| !name.contains("support_"));
        let global = take_head(&mut tensors, "global", GLOBAL_CONDITION, 12)?;
        let local = take_head(&mut tensors, "local", LOCAL_CONDITION, 6)?;
        if let Some(extra) = tensors.keys().next() {
            return Err(wrong(format!("it has a tensor `{extra}` that schema {SCHEMA_VERSION} does not")));
        }
        Ok(Self {
            extractor: config.extractor.clone(),
            proposer: config.proposer.clone(),
            global,
            local,
            provenance: Provenance {
                data: "released by the paper's authors".into(),
                ..Provenance::default()
            },
        })
    }
}

fn take(tensors: &mut ReleasedTensors, name: &str, shape: &[usize]) -> Result<Vec<f32>, AtcError> {
    let (found, values) =
        tensors.remove(name).ok_or_else(|| wrong(format!("the tensor `{name}` is missing")))?;
    if found != shape || values.len() != shape.iter().product::<usize>() {
        return Err(wrong(format!("the tensor `{name}` has shape {found:?}, expected {shape:?}")));
    }
    if let Some(i) = values.iter().position(|v| !v.is_finite()) {
        return Err(wrong(format!("element {i} of the tensor `{name}` is not finite")));
    }
    Ok(values)
}

fn take_head(
    tensors: &mut ReleasedTensors,
    which: &str,
    inputs: usize,
    outputs: usize,
) -> Result<Head, AtcError> {
    let first = format!("{which}_head.0.bias");
    let hidden = match tensors.get(&first).map(|(shape, _)| shape.as_slice()) {
        Some([hidden]) if *hidden > 0 => *hidden,
        Some(shape) => {
            return Err(wrong(format!("the tensor `{first}` has shape {shape:?}, expected one side")));
        }
        None => return Err(wrong(format!("the tensor `{first}` is missing"))),
    };
    let mut layer = |position: usize, inputs: usize, outputs: usize| -> Result<Linear, AtcError> {
        let name = format!("{which}_head.{position}");
        Ok(Linear {
            weight: take(tensors, &format!("{name}.weight"), &[outputs, inputs])?,
            bias: take(tensors, &format!("{name}.bias"), &[outputs])?,
        })
    };
    let layers = [layer(0, inputs, hidden)?, layer(2, hidden, hidden)?, layer(4, hidden, outputs)?];
    let mut statistics = |name: &str, columns: usize| -> Result<Statistics, AtcError> {
        Ok(Statistics {
            median: take(tensors, &format!("{name}_median"), &[columns])?,
            range: take(tensors, &format!("{name}_scale"), &[columns])?,
        })
    };
    Ok(Head {
        mlp: Mlp { layers },
        residual: statistics(which, outputs)?,
        condition: statistics(&format!("{which}_condition"), inputs)?,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use use3d_numerics::math;

    fn released() -> ReleasedTensors {
        let mut out = ReleasedTensors::new();
        let mut add = |name: String, shape: Vec<usize>| {
            let n = shape.iter().product::<usize>();
            let values = (0..n).map(|i| math::sin(i as f32 * 0.37 + name.len() as f32) * 0.1).collect();
            out.insert(name, (shape, values));
        };
        for (head, inputs, hidden, outputs) in [("global", 30, 16, 12), ("local", 54, 24, 6)] {
            for (position, (i, o)) in [(0, (inputs, hidden)), (2, (hidden, hidden)), (4, (hidden, outputs))] {
                add(format!("{head}_head.{position}.weight"), vec![o, i]);
                add(format!("{head}_head.{position}.bias"), vec![o]);
            }
            for (part, n) in [("", outputs), ("_condition", inputs)] {
                add(format!("{head}{part}_median"), vec![n]);
                add(format!("{head}{part}_scale"), vec![n]);
            }
        }
        add("support_logit".into(), vec![3]);
        out
    }

    #[test]
    fn the_released_layout_loads_and_survives_our_own_file() {
        let calibrator = Calibrator::from_named_tensors(released(), &ReleasedConfig::default()).unwrap();
        assert_eq!(calibrator.extractor.form, Form::Linear);
        assert!(calibrator.provenance.data.contains("authors"));
        assert_eq!(calibrator.global.mlp.layers[1].inputs(), 16);
        assert_eq!(calibrator.local.mlp.layers[2].weight, released()["local_head.4.weight"].1);
        assert_eq!(calibrator.local.residual.range, released()["local_scale"].1);
        assert_eq!(calibrator.global.condition.median, released()["global_condition_median"].1);
        let bytes = calibrator.to_bytes().unwrap();
        assert_eq!(bytes, calibrator.to_bytes().unwrap());
        assert_eq!(Calibrator::from_bytes(&bytes).unwrap(), calibrator);
    }

    #[test]
    fn anything_missing_extra_or_misshapen_is_named() {
        let config = ReleasedConfig::default();
        let fails = |tensors: ReleasedTensors| {
            Calibrator::from_named_tensors(tensors, &ReleasedConfig::default()).unwrap_err().to_string()
        };
        for name in released().keys().filter(|n| !n.starts_with("support_")) {
            let mut missing = released();
            missing.remove(name);
            let message = fails(missing);
            assert!(message.contains(name.as_str()), "{message}");
            let mut misshapen = released();
            misshapen.get_mut(name).unwrap().0.push(1);
            assert!(fails(misshapen).contains(name.as_str()));
        }
        let mut extra = released();
        extra.insert("momentum".into(), (vec![1], vec![0.0]));
        assert!(fails(extra).contains("momentum"));
        let mut infinite = released();
        infinite.get_mut("local_scale").unwrap().1[2] = f32::INFINITY;
        assert!(fails(infinite).contains("not finite"));
        let from = |config: ReleasedConfig| Calibrator::from_named_tensors(released(), &config);
        assert!(from(ReleasedConfig { schema_version: 4, ..config.clone() }).is_err());
        assert!(from(ReleasedConfig { schema: "another".into(), ..config.clone() }).is_err());
        assert!(from(ReleasedConfig { schema: String::new(), ..config }).is_ok());
    }
}
