//! The calibrator on disk: one safetensors file.
//!
//! The tensors are `<head>.<layer>.weight`, `<head>.<layer>.bias` (layers 0 to 2, weights
//! `[outputs, inputs]`) and `<head>.{condition,residual}.{median,range}` for the heads `global` and
//! `local`, all f32. The header records the extractor's settings, the proposer, and the calibrator's
//! provenance.

use serde::{Deserialize, Serialize};
use use3d_tensors::{TensorFile, TensorWriter};

use super::{Calibrator, GLOBAL_CONDITION, Head, LOCAL_CONDITION, Linear, Mlp, Provenance, Statistics};
use crate::error::AtcError;
use crate::extractor::ExtractorSettings;
use crate::proposers::ProposerId;
use crate::tensors::Reader;

const WHAT: &str = "calibrator";
const FORMAT: &str = "3d-use calibrator";
const VERSION: u64 = 1;

#[derive(Serialize, Deserialize)]
struct CalibratorHeader {
    format: String,
    version: u64,
    extractor: ExtractorSettings,
    proposer: ProposerId,
    provenance: Provenance,
}

impl Calibrator {
    /// The calibrator as the bytes of a safetensors file; equal calibrators have equal bytes.
    pub fn to_bytes(&self) -> Result<Vec<u8>, AtcError> {
        let mut writer = TensorWriter::new();
        for (name, head) in [("global", &self.global), ("local", &self.local)] {
            for (i, layer) in head.mlp.layers.iter().enumerate() {
                let shape = [layer.outputs(), layer.inputs()];
                writer.f32(&format!("{name}.{i}.weight"), &shape, &layer.weight);
                writer.f32(&format!("{name}.{i}.bias"), &shape[..1], &layer.bias);
            }
            for (part, statistics) in [("condition", &head.condition), ("residual", &head.residual)] {
                let shape = [statistics.median.len()];
                writer.f32(&format!("{name}.{part}.median"), &shape, &statistics.median);
                writer.f32(&format!("{name}.{part}.range"), &shape, &statistics.range);
            }
        }
        let header = CalibratorHeader {
            format: FORMAT.into(),
            version: VERSION,
            extractor: self.extractor.clone(),
            proposer: self.proposer.clone(),
            provenance: self.provenance.clone(),
        };
        writer.finish_with(&header).map_err(|e| AtcError::artifact(WHAT, e.to_string()))
    }

    /// True if these bytes, complete or not, were written by this program; false for the authors'
    /// calibrators.
    pub fn is_own_file(bytes: &[u8]) -> bool {
        TensorFile::has_document(bytes)
    }

    /// Reads a calibrator from the bytes of a safetensors file.
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, AtcError> {
        let reader = Reader::new(WHAT, bytes)?;
        let header: CalibratorHeader = reader.header(FORMAT, VERSION)?;
        header.extractor.validate().map_err(|e| reader.error(format!("extractor: {e}")))?;
        Ok(Self {
            extractor: header.extractor,
            proposer: header.proposer,
            global: read_head(&reader, "global", GLOBAL_CONDITION, 12)?,
            local: read_head(&reader, "local", LOCAL_CONDITION, 6)?,
            provenance: header.provenance,
        })
    }
}

fn read_head(reader: &Reader<'_>, name: &str, inputs: usize, outputs: usize) -> Result<Head, AtcError> {
    let [hidden] = reader.sides(&format!("{name}.0.bias"), "one side")?;
    if hidden == 0 {
        return Err(reader.error(format!("the tensor `{name}.0.bias` has no values")));
    }
    let layer = |i: usize, inputs: usize, outputs: usize| -> Result<Linear, AtcError> {
        Ok(Linear {
            weight: reader.f32(&format!("{name}.{i}.weight"), &[outputs, inputs])?,
            bias: reader.f32(&format!("{name}.{i}.bias"), &[outputs])?,
        })
    };
    let statistics = |part: &str, columns: usize| -> Result<Statistics, AtcError> {
        Ok(Statistics {
            median: reader.f32(&format!("{name}.{part}.median"), &[columns])?,
            range: reader.f32(&format!("{name}.{part}.range"), &[columns])?,
        })
    };
    Ok(Head {
        mlp: Mlp {
            layers: [layer(0, inputs, hidden)?, layer(1, hidden, hidden)?, layer(2, hidden, outputs)?],
        },
        condition: statistics("condition", inputs)?,
        residual: statistics("residual", outputs)?,
    })
}
