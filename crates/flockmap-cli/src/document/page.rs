//! The page of a report: one file for any browser, also a phone's.

use maud::{DOCTYPE, Markup, PreEscaped, html};

use super::data_table::{Cell, DataTable};
use super::model::{Document, Part};
use crate::program::command_line;

const STYLE: &str = include_str!("page.css");

/// The page, with everything in it.
pub(super) fn render(document: &Document) -> String {
    let Document { title, verdicts, sections, .. } = document;
    let titled = || sections.iter().filter(|section| !section.title.is_empty());
    html! {
        (DOCTYPE)
        html lang="en" {
            head {
                meta charset="utf-8";
                meta name="viewport" content="width=device-width, initial-scale=1";
                meta name="color-scheme" content="light dark";
                title { "Flockmap: " (title) }
                style { (PreEscaped(STYLE)) }
            }
            body {
                main {
                    header { h1 { "Flockmap" } p.title { (title) } }
                    @for verdict in verdicts {
                        @let (kind, class) = verdict.kind();
                        p class={ "verdict " (class) } { b { (kind) } " " (inline(verdict.words())) }
                    }
                    @if titled().count() > 2 {
                        nav { @for section in titled() { a href={ "#" (section.id) } { (section.title) } " " } }
                    }
                    @for section in sections {
                        section id=(section.id) {
                            @if !section.title.is_empty() { h2 { (section.title) } }
                            @for part in &section.parts { (of_part(part)) }
                        }
                    }
                    footer {
                        p { "Made by " code { (command_line()) } }
                        p { "flockmap " (env!("CARGO_PKG_VERSION")) }
                    }
                }
            }
        }
    }
    .into_string()
}

fn of_part(part: &Part) -> Markup {
    match part {
        Part::Words(words) => html! { p { (inline(words)) } },
        Part::Points(points) => html! { ul { @for point in points { li { (inline(point)) } } } },
        Part::Table(table) => of_table(table),
        Part::Figure(figure) => figure.clone(),
    }
}

/// A table that scrolls inside its own box.
fn of_table(table: &DataTable) -> Markup {
    let is_words: Vec<bool> = (0..table.columns.len()).map(|column| table.is_words(column)).collect();
    let is_words = |column: usize| is_words.get(column).copied().unwrap_or(false);
    // What stands side by side on a wide screen stands one below the other on a narrow one.
    let is_stacked = table.columns.len() < 4 && (1..table.columns.len()).any(is_words);
    html! {
        div.scroll {
            table.stacked[is_stacked] {
                thead {
                    tr {
                        @for (column, (_, heading)) in table.columns.iter().enumerate() {
                            th.words[is_words(column)] { (heading) }
                        }
                    }
                }
                tbody {
                    @for (number, row) in table.rows.iter().enumerate() {
                        tr.sum[table.sum == Some(number)] {
                            @for (column, cell) in row.iter().enumerate() {
                                @if column == 0 { th.words[is_words(0)] { (cell.shown()) } }
                                @else {
                                    td.missing[*cell == Cell::Missing].words[is_words(column)] { (cell.shown()) }
                                }
                            }
                        }
                    }
                }
            }
        }
        @if !table.note.is_empty() { p.note { (inline(&table.note)) } }
        (terms(&table.terms))
    }
}

/// Words and what they mean.
pub fn terms(terms: &[(&'static str, String)]) -> Markup {
    html! {
        @if !terms.is_empty() {
            dl.terms { @for (term, meaning) in terms { div { dt { (term) } dd { (inline(meaning)) } } } }
        }
    }
}

/// Text; what stands between backticks is code.
fn inline(words: &str) -> Markup {
    html! {
        @for (number, piece) in words.split('`').enumerate() {
            @if number % 2 == 1 { code { (piece) } } @else { (piece) }
        }
    }
}
