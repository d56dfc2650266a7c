//! The LiDARs that are simulated.

/// Time between the starts of two scans: 0.1 s.
pub const SCAN_PERIOD_MICROS: i64 = 100_000;

/// A LiDAR: a scan pattern in the frame of the sensor (x forward, y left, z up), 10 scans a second.
///
/// The patterns of Avia and Mid-360 run on with time and hardly ever repeat; which beams a scan has depends
/// on nothing but its stamp. The other two have the same beams in every scan.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
pub enum Lidar {
    /// Livox Avia: looks forward, 70.4° × 77.2°, 24,000 beams a scan. The rosette of the MARSIM simulator:
    /// two rotations of 7,294 and −4,664 rpm added up, one base point each 25 µs, on 6 rows 1.4° apart.
    Avia,
    /// Livox Mid-360: looks all around, −7° … +52°, 20,000 beams a scan, 5 µs apart. Rate of azimuth
    /// (62,050.63 °/s) and shape of the elevation (22.5° + 25.5° · cos 10 Hz + 4° · wobble) are MARSIM's;
    /// azimuth is not rounded to whole degrees as there, and the wobble is a product of cosines of 1,137.1
    /// and 87.3 Hz, so that scan lines fall elsewhere in each scan as they do on the real device.
    #[default]
    Mid360,
    /// MARSIM's VLP-32: looks all around, 32 rows every 1.2° from −25° to +12.2°, 1,800 columns every 0.2°:
    /// 57,600 beams a scan.
    Vlp32,
    /// MARSIM's OS-128: looks all around, 128 rows every 0.4° from −22.5° to +28.3°, 1,800 columns every
    /// 0.2° (the real device has 512, 1,024 or 2,048): 230,400 beams a scan.
    Os128,
}

/// The names of each, its own first.
const NAMES: [(&str, Lidar); 7] = [
    ("avia", Lidar::Avia),
    ("mid360", Lidar::Mid360),
    ("mid-360", Lidar::Mid360),
    ("vlp32", Lidar::Vlp32),
    ("vlp-32", Lidar::Vlp32),
    ("os128", Lidar::Os128),
    ("os-128", Lidar::Os128),
];

impl core::str::FromStr for Lidar {
    type Err = String;

    fn from_str(name: &str) -> Result<Self, String> {
        let named = NAMES.iter().find(|(known, _)| *known == name).map(|(_, lidar)| *lidar);
        named.ok_or_else(|| format!("\"{name}\" is no LiDAR: use mid360, avia, vlp32 or os128"))
    }
}

impl core::fmt::Display for Lidar {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        let named = NAMES.iter().find(|(_, lidar)| lidar == self);
        f.write_str(named.map_or("", |(name, _)| name))
    }
}

impl Lidar {
    /// Every LiDAR.
    pub const ALL: [Self; 4] = [Self::Avia, Self::Mid360, Self::Vlp32, Self::Os128];

    /// Lowest and highest azimuth and elevation of any beam, in degrees.
    pub const fn field_of_view_deg(self) -> ([f64; 2], [f64; 2]) {
        match self {
            Self::Avia => ([-35.2, 35.2], [-38.6, 38.6]),
            Self::Mid360 => ([-180.0, 180.0], [-7.0, 52.0]),
            Self::Vlp32 => ([-180.0, 180.0], [-25.0, 12.2]),
            Self::Os128 => ([-180.0, 180.0], [-22.5, 28.3]),
        }
    }

    /// Whether every scan has the same beams.
    pub const fn repeats(self) -> bool {
        matches!(self, Self::Vlp32 | Self::Os128)
    }
}
