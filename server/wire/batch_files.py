"""Sends the table and the contact sheet of a batch. Table and sheet are made while they are sent."""

from typing import Literal

from fastapi import Response
from fastapi.responses import StreamingResponse

from rig.messages.message import compose
from server.errors import Conflict
from server.services.service import Service

TableFormat = Literal["csv", "parquet"]
SheetFormat = Literal["html", "pdf"]
PDF_TYPE = "application/pdf"
PARQUET_TYPE = "application/vnd.apache.parquet"
CLOSED = "sandbox allow-popups; default-src 'none'; style-src 'unsafe-inline'; img-src data:"


def send_table(service: Service, batch_id: str, form: TableFormat) -> Response:
    """Returns the response that carries the table of a batch. Raises NotFound, and Conflict for Parquet if pyarrow is
    not installed."""
    from server.batch.table import CSV, PARQUET, csv_lines, has_parquet, parquet_bytes
    from server.services.batch_table import batch_columns, batch_rows

    batch = service.batches.get(batch_id)
    columns = batch_columns(batch)
    rows = batch_rows(service.batches, service.store, batch, columns)
    if form == "csv":
        return StreamingResponse(csv_lines(columns, rows), media_type="text/csv", headers=_saved_as(CSV))
    if not has_parquet():
        raise Conflict("no-parquet", compose("batch-parquet-missing"))
    return Response(parquet_bytes(columns, list(rows)), media_type=PARQUET_TYPE, headers=_saved_as(PARQUET))


def send_sheet(service: Service, batch_id: str, form: SheetFormat) -> Response:
    """Returns the response that carries the contact sheet of a batch. The HTML page's headers forbid scripts, since
    people's labels stand on it. Raises NotFound."""
    from server.batch.sheet import sheet_lines
    from server.services.batch_table import batch_cards

    batch, headers = service.batches.get(batch_id), {"Content-Disposition": f'inline; filename="sheet.{form}"'}
    title, cards = batch.label or batch.id, batch_cards(service.batches, service.store, batch)
    if form == "pdf":
        from server.batch.sheet_pdf import sheet_pdf  # its library takes a while to load

        return Response(sheet_pdf(title, cards), media_type=PDF_TYPE, headers=headers)
    headers["Content-Security-Policy"] = CLOSED
    lines = (f"{line}\n".encode("utf-8", "replace") for line in sheet_lines(title, cards))
    return StreamingResponse(lines, media_type="text/html", headers=headers)


def _saved_as(name: str) -> dict[str, str]:
    return {"Content-Disposition": f'attachment; filename="{name}"'}
