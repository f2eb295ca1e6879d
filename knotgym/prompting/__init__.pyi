from .transcripts import reading_scores as reading_scores
from .transcripts import reading_table as reading_table
