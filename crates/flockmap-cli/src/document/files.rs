//! The files of a report.

use std::path::Path;

use anyhow::Context;
use serde::Serialize;

use super::model::Document;
use super::page;
use crate::json_file;

impl Document {
    /// Writes one of the tables as CSV.
    ///
    /// # Errors
    /// If there is no such table, or the file cannot be written.
    pub fn write_csv(&self, id: &str, path: &Path) -> anyhow::Result<()> {
        let table =
            self.tables().find(|table| table.id == id).with_context(|| format!("there is no table {id}"))?;
        put(path, table.csv())
    }

    /// Writes `report.html`, `report.json`, a CSV file for each table that has a name, and the pictures into
    /// a folder, which is made if it is not there.
    ///
    /// # Errors
    /// If one of them cannot be written.
    pub fn write(&self, folder: &Path, json: &impl Serialize) -> anyhow::Result<()> {
        std::fs::create_dir_all(folder)
            .with_context(|| format!("cannot make the folder {}", folder.display()))?;
        json_file::write(&folder.join("report.json"), json)?;
        for table in self.tables() {
            put(&folder.join(format!("{}.csv", table.id)), table.csv())?;
        }
        for (name, picture) in &self.pictures {
            put(&folder.join(name), picture.clone())?;
        }
        let page = folder.join("report.html");
        put(&page, page::render(self))?;
        println!("\n  report: {}", page.display());
        Ok(())
    }
}

fn put(path: &Path, text: String) -> anyhow::Result<()> {
    std::fs::write(path, text).with_context(|| format!("cannot write {}", path.display()))
}
