//! The text of a report.

use super::model::{Document, Part};

impl Document {
    /// Everything but what only the page can show; long tables only if `all`.
    pub fn print(&self, all: bool) {
        println!("{}", self.title);
        if !self.about.is_empty() {
            println!("  {}", self.about);
        }
        for section in &self.sections {
            if !self.is_plain {
                println!("\n{}", section.title);
            }
            let shown = section.parts.iter().filter_map(|part| match part {
                Part::Words(words) => Some(wrapped(words, "  ", "  ")),
                Part::Points(points) => {
                    let points = points.iter().map(|point| wrapped(point, "  - ", "    "));
                    Some(points.collect::<Vec<_>>().join("\n"))
                }
                Part::Table(table) if all || !table.is_long => {
                    Some(format!("{table}{}", wrapped(&table.note, "  ", "  ").trim_end()))
                }
                Part::Table(_) | Part::Figure(_) => None,
            });
            for (number, text) in shown.enumerate() {
                println!("{}{text}", if number == 0 { "\n" } else { "" });
            }
        }
        println!();
        for verdict in &self.verdicts {
            println!("{}", wrapped(&format!("{}: {}", verdict.kind().0, verdict.words()), "  ", "  "));
        }
    }
}

/// Text in lines of at most some 120 characters.
fn wrapped(words: &str, first: &str, others: &str) -> String {
    let mut text = String::new();
    let mut line = first.to_owned();
    let mut empty = true;
    for word in words.split_whitespace() {
        if !empty && line.chars().count() + 1 + word.chars().count() > 120 {
            text += &line;
            text.push('\n');
            line = others.to_owned();
            empty = true;
        }
        if !empty {
            line.push(' ');
        }
        line += word;
        empty = false;
    }
    text + &line
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn words_are_wrapped_and_none_is_lost() {
        let words = "word ".repeat(100);
        let text = wrapped(&words, "  - ", "    ");
        assert!(text.lines().all(|line| line.chars().count() <= 120));
        assert_eq!(text.matches("word").count(), 100);
    }
}
