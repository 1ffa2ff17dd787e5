"""The documents' pictures from what `make demo` made: `make pictures` writes docs/pictures/."""

from pathlib import Path

from PIL import Image

ROOT = Path(__file__).resolve().parents[2]
DEMO, PICTURES = ROOT / "out" / "demo", ROOT / "docs" / "pictures"
WIDTH_PX, QUALITY = 1200, 85
ROWS, SHOWN = 4, 2  # rows of the contact sheet, a camera each; the one that is shown, from the side


def main() -> None:
    PICTURES.mkdir(exist_ok=True)
    with Image.open(DEMO / "contact_sheet.png") as sheet:
        height = sheet.height // ROWS
        _write("shot.jpg", sheet.crop((0, SHOWN * height, sheet.width, (SHOWN + 1) * height)))
    with Image.open(DEMO / "turntable.png") as turntable:
        _write("turntable.jpg", turntable)


def _write(name: str, picture: Image.Image) -> None:
    size = (WIDTH_PX, round(picture.height * WIDTH_PX / picture.width))
    picture.convert("RGB").resize(size, Image.Resampling.LANCZOS).save(PICTURES / name, quality=QUALITY, optimize=True)


if __name__ == "__main__":
    main()
