//! How options stand in files where their unit is another one there: for `#[serde(with)]`, which the schema
//! follows.

use std::borrow::Cow;

use schemars::{JsonSchema, Schema, SchemaGenerator};
use serde::de::Error;
use serde::{Deserialize, Deserializer, Serialize, Serializer};

use crate::Resolution;

/// A whole number, of which one in the file is `N`.
pub struct Times<const N: u64>;

/// Bytes, in MiB in the file.
pub type Mebibytes = Times<{ 1 << 20 }>;

impl<const N: u64> Times<N> {
    pub fn serialize<T: Copy + TryInto<u64>, S: Serializer>(value: &T, to: S) -> Result<S::Ok, S::Error> {
        (*value).try_into().map_or(0, |value| value / N).serialize(to)
    }

    pub fn deserialize<'de, T: TryFrom<u64>, D: Deserializer<'de>>(from: D) -> Result<T, D::Error> {
        let value = u64::from(u32::deserialize(from)?) * N;
        T::try_from(value).map_err(|_| D::Error::custom("more than this machine can count"))
    }
}

/// A limit, of which one in the file is `N`, and 0 is none; at least `MIN`.
pub struct UnlessZero<const N: u32, const MIN: u32>;

impl<const N: u32, const MIN: u32> UnlessZero<N, MIN> {
    pub fn serialize<S: Serializer>(limit: &Option<u32>, to: S) -> Result<S::Ok, S::Error> {
        (f64::from(limit.unwrap_or(0)) / f64::from(N)).serialize(to)
    }

    pub fn deserialize<'de, D: Deserializer<'de>>(from: D) -> Result<Option<u32>, D::Error> {
        let [n, least] = [N, MIN].map(f64::from);
        match f64::deserialize(from)? * n {
            0.0 => Ok(None),
            limit if (least..=4e9).contains(&limit) => Ok(Some(limit as u32)),
            _ => Err(D::Error::custom(format_args!("expected 0 for no limit, or at least {:.2}", least / n))),
        }
    }
}

impl<const N: u64> JsonSchema for Times<N> {
    fn schema_name() -> Cow<'static, str> {
        u32::schema_name()
    }

    fn json_schema(generator: &mut SchemaGenerator) -> Schema {
        u32::json_schema(generator)
    }
}

impl<const N: u32, const MIN: u32> JsonSchema for UnlessZero<N, MIN> {
    fn schema_name() -> Cow<'static, str> {
        f64::schema_name()
    }

    fn json_schema(generator: &mut SchemaGenerator) -> Schema {
        f64::json_schema(generator)
    }
}

impl TryFrom<f64> for Resolution {
    type Error = &'static str;

    fn try_from(metres: f64) -> Result<Self, Self::Error> {
        Self::from_metres(metres)
            .ok_or("expected the side of a voxel in metres, 0.001 to 100, for example 0.1")
    }
}

impl From<Resolution> for f64 {
    fn from(resolution: Resolution) -> Self {
        resolution.metres()
    }
}
