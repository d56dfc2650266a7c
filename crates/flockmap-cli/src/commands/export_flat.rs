//! `flockmap export` of what planners in two dimensions want, and of pictures.

use std::path::Path;

use anyhow::{Context, ensure};
use clap::{Args, ValueEnum};
use flockmap::MapView;
use flockmap::grid::{Changes, Resolution, State, Voxel, VoxelBox};
use flockmap_cli::given::Given;
use flockmap_cli::numbers::thousands;
use flockmap_io::{Scale, check_writable, export_heights, export_occupancy, export_values, occupancy_yaml};
use flockmap_plan::{
    ColumnRule, DistanceField, FieldConfig, HeightMap, Obstacles, OccupancyGrid, box_between,
};

/// What of a map becomes a picture.
#[derive(Clone, Copy, PartialEq, Eq, Debug, ValueEnum)]
pub enum Product {
    /// Occupied, free and unknown columns, for Nav2's map_server: .pgm or .png, and a .yaml beside it
    Occupancy,
    /// How high what stands in each column is, in colours: .png
    Heights,
    /// The same as numbers: .png of 16 bits, in millimetres above the lower end of --band
    HeightValues,
    /// How far the nearest obstacle of the --area and --band is from each voxel at the height --at, in colours: .png
    Distances,
}

/// Bytes that the distance field of a picture may take.
const FIELD_BYTES_MAX: u64 = 1 << 30;

/// Which picture, and of what.
#[derive(Args, Debug, Clone)]
#[command(next_help_heading = "Pictures from above: .pgm and .png")]
pub struct FlatArgs {
    #[command(flatten)]
    pub given: Given,
    /// What of the map
    #[arg(long, value_enum, value_name = "WHAT", default_value_t = Product::Occupancy)]
    pub product: Product,
    /// Heights in metres that count, in the frame of the map: what the robot would hit. One voxel high it is a
    /// slice. Needed for occupancy [default: all heights]
    #[arg(long, value_names = ["LOW", "HIGH"], num_args = 2, allow_negative_numbers = true)]
    pub band: Option<Vec<f64>>,
    /// Lowest x and y, highest x and y in metres [default: all that is known]
    #[arg(long, value_names = ["X0", "Y0", "X1", "Y1"], num_args = 4, allow_negative_numbers = true)]
    pub area: Option<Vec<f64>>,
    /// A cell is free only if its whole column in the band is, not some of it (occupancy)
    #[arg(long)]
    pub all_free: bool,
    /// Height of the voxels in metres, in the frame of the map (distances)
    #[arg(long, value_name = "HEIGHT", allow_negative_numbers = true)]
    pub at: Option<f64>,
    /// What is unknown counts as an obstacle too (distances)
    #[arg(long)]
    pub unknown_too: bool,
}

/// The names of the options of [`FlatArgs`].
pub const OF_PICTURES: [&str; 6] = ["product", "band", "area", "all_free", "at", "unknown_too"];

impl FlatArgs {
    /// Whether this can be made, before the work of a map.
    pub fn check(&self, to: &Path) -> anyhow::Result<()> {
        if self.product == Product::Occupancy {
            ensure!(
                self.band.is_some(),
                "--to {}: which heights would the robot hit? Give --band LOW HIGH in metres, as --band 0.2 2 (in the \
                 frame of the map, whose 0 may be the start of the sensor and not the ground)",
                to.display()
            );
            let yaml = occupancy_yaml(to);
            check_writable(&yaml).with_context(|| format!("{}, which goes with it", yaml.display()))?;
        } else {
            let is_png = to.extension().is_some_and(|ending| ending.eq_ignore_ascii_case("png"));
            ensure!(is_png, "--to {}: heights become a .png", to.display());
            self.given.refuse(&["all_free"], "is for --product occupancy")?;
        }
        if self.product == Product::Distances {
            let at = self.at.with_context(|| {
                format!(
                    "--to {}: distances at which height? Give --at HEIGHT in metres, as --at 1",
                    to.display()
                )
            })?;
            ensure!(at.is_finite(), "--at is {at}, expected metres");
        } else {
            self.given.refuse(&["at", "unknown_too"], "is for --product distances")?;
        }
        Ok(())
    }

    /// Writes the picture of a map.
    pub fn write(&self, to: &Path, resolution: Resolution, map: &Changes) -> anyhow::Result<()> {
        let mut view = MapView::new(resolution);
        for (index, block) in map.blocks() {
            view.set_block(*index, block);
        }
        let region = self.region(&view)?;
        let cells = match self.product {
            Product::Occupancy => {
                let rule = if self.all_free { ColumnRule::AllFree } else { ColumnRule::AnyFree };
                let grid = OccupancyGrid::new(&view, &region, rule)?;
                export_occupancy(to, &grid)?;
                let (free, occupied) = grid.count();
                let yaml = occupancy_yaml(to);
                println!(
                    "{}: {} free and {} occupied cells; {} says where they lie",
                    to.display(),
                    thousands(free as u64),
                    thousands(occupied as u64),
                    yaml.display()
                );
                grid.size()
            }
            Product::Heights => {
                let heights = HeightMap::new(&view, &region)?;
                let tops = heights.tops_m();
                let scale = Scale::of(&tops);
                let is_known = |x, y| heights.is_known(x, y);
                export_values(to, heights.size(), &tops, is_known, scale, "heights in m")?;
                println!(
                    "{}: heights from {:.2} m (blue) to {:.2} m (orange); white: nothing there, grey: unknown",
                    to.display(),
                    scale.low,
                    scale.high
                );
                heights.size()
            }
            Product::HeightValues => {
                let heights = HeightMap::new(&view, &region)?;
                export_heights(to, &heights)?;
                let low = f64::from(region.min().z) * resolution.metres();
                println!("{}: height = {low:.3} m + value in mm; 0: nothing there", to.display());
                heights.size()
            }
            Product::Distances => self.write_distances(to, &view, region)?,
        };
        println!("  {} × {} cells of {} m", cells[0], cells[1], resolution.metres());
        Ok(())
    }

    /// Returns how many cells the picture has.
    fn write_distances(&self, to: &Path, view: &MapView, region: VoxelBox) -> anyhow::Result<[usize; 2]> {
        let at = self.at.unwrap_or_default();
        let side = view.resolution().metres();
        let (min, max) = (region.min(), region.max());
        let z = (at / side).floor() as i32;
        ensure!(
            (min.z..=max.z).contains(&z),
            "--at {at}: expected a height in the box, {:.2} to {:.2} m (--band makes it larger)",
            f64::from(min.z) * side,
            f64::from(max.z + 1) * side
        );
        let obstacles = if self.unknown_too { Obstacles::NotFree } else { Obstacles::Occupied };
        let config = FieldConfig { obstacles, memory_max: FIELD_BYTES_MAX };
        let field = DistanceField::new(view, region, &config).context("--area and --band say which box")?;
        let known = |x, y| view.state(Voxel::new(x, y, z)) != State::Unknown;
        let distance = |x, y| field.distance(Voxel::new(x, y, z)).filter(|_| known(x, y)).unwrap_or(f64::NAN);
        let rows = (min.y..=max.y).flat_map(|y| (min.x..=max.x).map(move |x| (x, y)));
        let distances: Vec<f32> = rows.map(|(x, y)| distance(x, y) as f32).collect();
        let size = [region.size()[0] as usize, region.size()[1] as usize];
        let scale = Scale { low: 0.0, ..Scale::of(&distances) };
        export_values(to, size, &distances, |_, _| false, scale, "distances in m")?;
        println!(
            "{}: metres to the nearest obstacle at {at} m, 0 (blue) to {:.2} (orange); grey: unknown",
            to.display(),
            scale.high
        );
        Ok(size)
    }

    /// The part of the map that was asked for.
    fn region(&self, view: &MapView) -> anyhow::Result<VoxelBox> {
        let known = view.bounding_box().context("nothing to export: no voxel is known")?;
        let side = view.resolution().metres();
        let [low, high] = [known.min(), known.max()];
        let mut low_m = [low.x, low.y, low.z].map(|v| f64::from(v) * side);
        let mut high_m = [high.x, high.y, high.z].map(|v| f64::from(v + 1) * side);
        let reach = format!("the map reaches from {:.1?} to {:.1?} m (x, y, z)", low_m, high_m);
        if let Some([low, high]) = self.band.as_deref() {
            (low_m[2], high_m[2]) = (*low, *high);
        }
        if let Some([x0, y0, x1, y1]) = self.area.as_deref() {
            (low_m[0], low_m[1], high_m[0], high_m[1]) = (*x0, *y0, *x1, *y1);
        }
        let region = box_between(view.resolution(), low_m, high_m).with_context(|| {
            let given = [("--band", &self.band), ("--area", &self.area)];
            let given = given.iter().filter_map(|(name, ends)| Some(format!("{name} {:?}", ends.as_ref()?)));
            format!(
                "{}: expected the lower ends first, finite and within the grid; {reach}",
                given.collect::<Vec<_>>().join(", ")
            )
        })?;
        ensure!(region.intersection(&known).is_some(), "nothing is known there: {reach}");
        Ok(region)
    }
}
