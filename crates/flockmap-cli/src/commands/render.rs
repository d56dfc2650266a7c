//! `flockmap render`: a picture of a map in three dimensions.

use std::fs::File;
use std::io::BufWriter;
use std::path::{Path, PathBuf};

use anyhow::{Context, bail, ensure};
use clap::Args;
use flockmap::MapView;
use flockmap::grid::Changes;
use flockmap_cli::numbers::thousands;
use flockmap_cli::options::{MapArgs, OF_BATCHES, SourceArgs};
use flockmap_cli::outputs;
use flockmap_cli::render::{Camera, PICTURE_SIDE_MAX, Picture, Style, render};
use flockmap_cli::sources::ending;

use super::voxels_of::voxels_of;

/// Draw a map in three dimensions: a PNG, without a browser or a graphics card
#[derive(Args, Debug)]
#[command(after_help = "\
Examples:
  flockmap render map.bt --out map.png
  flockmap render map.bt --out inside.png --heights -0.2 2 --elevation 60      (without the ceiling)
  flockmap render robot1.mcap --out walk.png --resolution 0.2 --range 30 --dark
  flockmap render fr_079.bt --out above.png --elevation 90 --azimuth -90

A record is mapped with the mapper options first. Colours are heights, blue below and orange above. The camera has no
perspective, so a pixel is as long everywhere; how long, is printed.", mut_args(super::hidden::hide(&[&OF_BATCHES])))]
pub struct RenderArgs {
    /// A record, a map, or a point cloud
    #[arg(value_name = "FILE")]
    pub file: PathBuf,
    /// The picture: a path that ends in .png
    #[arg(long, value_name = "PNG", value_parser = outputs::file())]
    pub out: PathBuf,
    /// Pixels across and down, such as 1600x1000
    #[arg(long, default_value = "1600x1000", value_parser = size)]
    pub size: [usize; 2],
    /// From which direction: degrees from +x (0) towards +y (90)
    #[arg(long, default_value_t = -60.0, allow_negative_numbers = true)]
    pub azimuth: f64,
    /// How high the camera stands above the horizon, in degrees; 90 looks straight down
    #[arg(long, default_value_t = 40.0, allow_negative_numbers = true)]
    pub elevation: f64,
    /// Only what is between these heights, in metres
    #[arg(long, num_args = 2, value_names = ["LOW", "HIGH"], allow_negative_numbers = true)]
    pub heights: Option<Vec<f64>>,
    /// On a dark ground
    #[arg(long)]
    pub dark: bool,
    #[command(flatten)]
    pub map: MapArgs,
    #[command(flatten)]
    pub source: SourceArgs,
}

/// Runs the command.
pub fn run(args: &RenderArgs) -> anyhow::Result<bool> {
    if ending(&args.out).as_deref() != Some("png") {
        bail!("--out {}: expected a path that ends in .png", args.out.display());
    }
    ensure!(
        args.azimuth.abs() <= 360.0 && args.elevation.abs() <= 90.0,
        "--azimuth {} --elevation {}: expected -360 to 360 and -90 to 90 degrees",
        args.azimuth,
        args.elevation
    );
    let heights_m = match args.heights.as_deref() {
        Some(&[low, high]) => {
            ensure!(low < high, "--heights {low} {high}: expected the lower height first");
            [low, high]
        }
        _ => [f64::NEG_INFINITY, f64::INFINITY],
    };
    let (resolution, voxels) = voxels_of(&args.file, &args.map, &args.source)?;
    let mut view = MapView::new(resolution);
    for (index, block) in Changes::from_voxels(voxels).blocks() {
        view.set_block(*index, block);
    }
    let camera = Camera::new(args.azimuth, args.elevation);
    let picture = render(&view, &Style { size: args.size, camera, heights_m, is_dark: args.dark })?;
    write(&args.out, &picture)?;
    let (voxels, side) = (thousands(picture.voxels as u64), picture.metres_per_pixel);
    println!(
        "{}: {voxels} occupied voxels of {} m, a pixel is {side:.3} m",
        args.out.display(),
        resolution.metres()
    );
    Ok(true)
}

fn size(text: &str) -> Result<[usize; 2], String> {
    let expected = || format!("expected such as 1600x1000, 16 to {PICTURE_SIDE_MAX} each");
    let (width, height) = text.split_once('x').ok_or_else(expected)?;
    let side = |text: &str| text.parse().ok().filter(|side| (16..=PICTURE_SIDE_MAX).contains(side));
    Ok([side(width).ok_or_else(expected)?, side(height).ok_or_else(expected)?])
}

fn write(path: &Path, picture: &Picture) -> anyhow::Result<()> {
    let wrong = || format!("cannot write {}", path.display());
    let out = BufWriter::new(File::create(path).with_context(wrong)?);
    let [width, height] = picture.size.map(|side| side as u32);
    let mut encoder = png::Encoder::new(out, width, height);
    encoder.set_color(png::ColorType::Rgb);
    encoder.set_depth(png::BitDepth::Eight);
    let mut writer = encoder.write_header().with_context(wrong)?;
    writer.write_image_data(picture.pixels.as_flattened()).with_context(wrong)?;
    writer.finish().with_context(wrong)
}
