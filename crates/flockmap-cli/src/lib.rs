//! What the programs `flockmap` and `flockmap-bench` share: where scans come from, a swarm in virtual time
//! with what is measured of it, and reports. It serves these two and promises nothing to others.
#![forbid(unsafe_code)]
#![allow(missing_docs, reason = "fields of measures and reports are said by their names")]

pub mod chart;
pub mod document;
pub mod explore;
pub mod flight;
pub mod given;
pub mod json_file;
pub mod map_figure;
pub mod measure;
pub mod member;
pub mod numbers;
pub mod options;
pub mod outputs;
pub mod parallel;
pub mod picture;
pub mod program;
pub mod progress;
pub mod radio_plan;
pub mod records;
pub mod render;
pub mod report;
pub mod robot_record;
pub mod sources;
pub mod stop;
pub mod swarm;
pub mod team;
pub mod view;
