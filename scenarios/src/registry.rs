//! Every message by its schema, so that anything on the network can be shown as JSON.

use rover_bus::{Beat, CancelRequest, GoalRequest, Progress, ResultRequest};
use rover_messages::{
    Fault, Nothing, Wire,
    approach::{DriveToFeedback, DriveToGoal, DriveToResult},
    arm::{ArmState, ExecuteFeedback, ExecuteGoal, ExecuteResult},
    codec::{self, BINCODE, Format, MAX_PAYLOAD_BYTES},
    imaging::{CaptureRequest, FrameReference, RawPair, StereoFrame},
    mobility::{
        DriveFeedback, DriveGoal, DriveResult, MastState, PointFeedback, PointGoal, PointResult,
        WheelsState,
    },
    panorama::{Panorama, PanoramaRequest},
    placement::{
        ContactFeedback, ContactGoal, ContactResult, PlaceFeedback, PlaceGoal, PlaceResult,
    },
    planning::{Plan, PlanRequest, SurveyReport, SurveyRequest},
    simulation::{
        DesignateRequest, InjectedFault, Pick, PickRequest, Score, ScoreRequest, TruePlace,
        TruthState, View, ViewRequest,
    },
    status::{FaultReport, ServiceStatus},
    target::{SelectRequest, Target},
};
use serde::{Serialize, de::DeserializeOwned};
use serde_json::{Value, json};

type Decoder = fn(&[u8], &str) -> Result<Value, String>;

/// A message type: its schema and how its bytes become JSON.
struct Entry {
    schema: String,
    decode: Decoder,
}

fn message<T: Wire>() -> Entry {
    Entry {
        schema: T::SCHEMA.into(),
        decode: |bytes, _| {
            let value: T = codec::decode(bytes, Format::Bincode, MAX_PAYLOAD_BYTES)
                .map_err(|e| e.to_string())?;
            serde_json::to_value(value).map_err(|e| e.to_string())
        },
    }
}

fn around<T: Serialize + DeserializeOwned>(schema: String) -> Entry {
    Entry {
        schema,
        decode: |bytes, schema| {
            let value: T = codec::decode_value(bytes, schema, Format::Bincode, MAX_PAYLOAD_BYTES)
                .map_err(|e| e.to_string())?;
            serde_json::to_value(value).map_err(|e| e.to_string())
        },
    }
}

fn action<G: Wire, F: Wire, R: Wire>() -> [Entry; 5] {
    [
        message::<G>(),
        message::<F>(),
        message::<R>(),
        around::<GoalRequest<G>>(format!("goal/1({})", G::SCHEMA)),
        around::<Progress<F, R>>(format!("progress/1({},{})", F::SCHEMA, R::SCHEMA)),
    ]
}

/// All message types.
pub struct Registry {
    entries: Vec<Entry>,
}

impl Default for Registry {
    fn default() -> Self {
        let mut entries = vec![
            message::<Nothing>(),
            message::<Fault>(),
            message::<ArmState>(),
            message::<CaptureRequest>(),
            message::<PanoramaRequest>(),
            message::<Panorama>(),
            message::<RawPair>(),
            message::<StereoFrame>(),
            message::<Plan>(),
            message::<PlanRequest>(),
            message::<SurveyReport>(),
            message::<SurveyRequest>(),
            message::<FrameReference>(),
            message::<MastState>(),
            message::<WheelsState>(),
            message::<DesignateRequest>(),
            message::<Pick>(),
            message::<PickRequest>(),
            message::<TruePlace>(),
            message::<InjectedFault>(),
            message::<Score>(),
            message::<ScoreRequest>(),
            message::<TruthState>(),
            message::<View>(),
            message::<ViewRequest>(),
            message::<FaultReport>(),
            message::<ServiceStatus>(),
            message::<SelectRequest>(),
            message::<Target>(),
            message::<Beat>(),
            message::<CancelRequest>(),
            message::<ResultRequest>(),
        ];
        entries.extend(action::<ExecuteGoal, ExecuteFeedback, ExecuteResult>());
        entries.extend(action::<PlaceGoal, PlaceFeedback, PlaceResult>());
        entries.extend(action::<PointGoal, PointFeedback, PointResult>());
        entries.extend(action::<DriveGoal, DriveFeedback, DriveResult>());
        entries.extend(action::<DriveToGoal, DriveToFeedback, DriveToResult>());
        entries.extend(action::<ContactGoal, ContactFeedback, ContactResult>());
        Self { entries }
    }
}

impl Registry {
    /// What a sample says, as JSON: `{ key, schema | encoding, value }`; a picture is
    /// `{ content_type, bytes }`, and what cannot be decoded says why in `error`.
    pub fn describe(&self, key: &str, encoding: &str, payload: &[u8]) -> Value {
        let (media_type, schema) = match encoding.split_once(';') {
            Some((media_type, schema)) => (media_type.trim(), Some(schema.trim())),
            None => (encoding.trim(), None),
        };
        if media_type == BINCODE {
            let schema = schema.unwrap_or_default();
            return match self.decode(schema, payload) {
                Ok(value) => json!({ "key": key, "schema": schema, "value": value }),
                Err(error) => {
                    json!({ "key": key, "schema": schema, "bytes": payload.len(), "error": error })
                }
            };
        }
        if media_type.starts_with("image/") {
            let value = json!({ "content_type": media_type, "bytes": payload.len() });
            return json!({ "key": key, "encoding": encoding, "value": value });
        }
        let text = std::str::from_utf8(payload);
        match text
            .ok()
            .and_then(|text| serde_json::from_str::<Value>(text).ok())
        {
            Some(value) => json!({ "key": key, "encoding": encoding, "value": value }),
            None => match text {
                Ok(text) => json!({ "key": key, "encoding": encoding, "value": text }),
                Err(_) => json!({ "key": key, "encoding": encoding, "bytes": payload.len() }),
            },
        }
    }

    /// A binary payload of that schema as JSON.
    ///
    /// # Errors
    /// An unknown schema, or what the codec found.
    pub fn decode(&self, schema: &str, payload: &[u8]) -> Result<Value, String> {
        let entry = self
            .entries
            .iter()
            .find(|entry| entry.schema == schema)
            .ok_or_else(|| format!("unknown schema `{schema}`"))?;
        (entry.decode)(payload, schema)
    }

    /// All schemas, sorted.
    pub fn schemas(&self) -> Vec<&str> {
        let mut schemas: Vec<_> = self.entries.iter().map(|e| e.schema.as_str()).collect();
        schemas.sort_unstable();
        schemas
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn every_schema_is_known_once() {
        let registry = Registry::default();
        let schemas = registry.schemas();
        assert!(schemas.windows(2).all(|w| w[0] != w[1]), "{schemas:?}");
        assert!(schemas.contains(&"progress/1(execute_feedback/1,execute_result/1)"));
    }

    #[test]
    fn a_binary_message_becomes_json_under_its_schema() {
        let fault = Fault::new("arm_planner", "no_path", "blocked").with("clearance_mm", 3.0);
        let bytes = codec::encode(&fault, Format::Bincode).unwrap();
        let encoding = codec::encoding::<Fault>(Format::Bincode);
        let shown = Registry::default().describe("r/fault/arm_planner", &encoding, &bytes);
        assert_eq!(shown["schema"], "fault/1");
        assert_eq!(shown["value"]["name"], "no_path");
        assert_eq!(shown["value"]["details"]["clearance_mm"], 3.0);
    }

    #[test]
    fn pictures_show_their_type_and_size_and_garbage_says_why() {
        let registry = Registry::default();
        let picture = registry.describe("r/imaging/body/left", "image/png", &[0; 12]);
        assert_eq!(
            picture["value"],
            json!({ "content_type": "image/png", "bytes": 12 })
        );
        let garbage = registry.describe("r/arm/state", "application/bincode;arm_state/1", &[255]);
        assert!(garbage["error"].as_str().unwrap().contains("arm_state/1"));
        let unknown = registry.describe("r/x", "application/bincode;x/9", &[]);
        assert!(
            unknown["error"]
                .as_str()
                .unwrap()
                .contains("unknown schema `x/9`")
        );
    }
}
