"""Statistical process control of a production line: charts, change points and capability."""
